"""What keeps the device safe: limits, faults, the stop path, signals, the watchdog."""
