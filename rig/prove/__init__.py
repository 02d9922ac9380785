"""Commissioning: from cables to a device whose axes, signs and zero are proved."""
