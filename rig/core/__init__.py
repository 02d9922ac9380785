"""The core: from a posture to the Modbus write, to the phone's word, and to a stop.

It imports ``rig.config`` and ``rig.journal`` and nothing else of rig. Signals, console,
page and telemetry listen to it.
"""
