"""One run of the device: plan, move, settle, measure, identify.

``motion`` and ``measuring`` are the path from a posture to the motors and back; they
import the device and its guards and nothing else.
"""
