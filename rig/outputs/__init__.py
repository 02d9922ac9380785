"""What a run says while it goes on: the console, telemetry, its results in files."""
