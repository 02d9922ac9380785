"""What a user of jaxcal has of the paper: its network, presets and datasets.

Its robot, figures, tables and claims are benchmarks: ``make reproduce``.
"""
