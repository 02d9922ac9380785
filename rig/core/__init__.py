"""What moves, measures and stops a device. Begin with `session`; then, downwards:

`motion` and `measure` on `proof` (how far), `record_check` (is it the device, where
it was), `device` (drives, phone, guards), `stop`, `drive` and `bus` (Modbus), `phone`,
`stream` and `attitude` (the IMU), `faults` (how a session ends).
It imports `rig.config` and `rig.journal` and nothing else of rig.
"""
