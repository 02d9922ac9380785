"""One run of the device: plan, move, settle, measure, identify.

``device``, ``motion`` and ``measuring`` are the path from a posture to the motors and
back; beside each other they import ``rig.config``, ``rig.device`` and ``rig.guard``.
"""
