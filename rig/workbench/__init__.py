"""Around the core, which it uses by public names; the core imports nothing of it.

``commission`` (from cables to a checked device), ``procedures`` (what a session does),
``identification`` (what follows from a run), ``outputs`` (console, reports, exports)
and ``live`` (the page).
"""
