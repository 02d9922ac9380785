"""What moves, measures and stops a device: `session` on `motion`, `measure`, `proof`,
`record_check` (is it the device) and `device`, these on `stop` and on a process of its
own that owns the line. Of rig it imports drives, readings, journal and config alone."""
