"""What moves, measures and stops a device: `session` on `motion`, `measure`, `proof`
(how far), `record_check` (is it the device) and `device` (drives, phone, guards), these
on `stop` and on a process of its own that owns the line. It imports drives, readings,
journal and config, and nothing else of rig.
"""
