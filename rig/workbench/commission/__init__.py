"""Commissioning: from cables to a device whose axes, signs and zero are proved.

Each step is a command of ``steps``; ``axis_check`` is the mathematics of ``axes``.
Nothing of a session imports this package.
"""
