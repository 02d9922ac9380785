"""What the rig keeps on disk: its runs, its device, and who moves it."""
