"""What is made of a run: the report, exports for controllers, the trend of several."""
