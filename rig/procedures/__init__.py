"""What a session is for: calibrate, collect, verify, goto."""
