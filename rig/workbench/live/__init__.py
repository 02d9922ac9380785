"""The live page: another process that reads a run's folder and shows it in a browser.

It can ask the session to pause or to stop, and can move nothing. A session knows
nothing of it: the commands start it, and it ends by itself.
"""
