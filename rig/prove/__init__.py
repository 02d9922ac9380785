"""Commissioning: from cables to a device whose axes, signs and zero are proved.

Each step is a command of ``steps``; ``axis_moves`` are made for ``axis_check``, the
mathematics of them.
"""
