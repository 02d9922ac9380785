"""Sequential measurement: published tasks, a family of tasks, what only compares."""
