"""Commissioning: from cables to a device whose axes, signs and zero are proved.

Each step is a command. ``findings`` is the mathematics of the axis check, ``bench`` the
armed device that every moving step shares with a session. Nothing of a session imports
this package.
"""
