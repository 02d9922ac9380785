"""What a user of jaxcal has of the paper: its network and preset, robot and datasets.

Its figures, tables and claims are a study of the repository: ``make reproduce``.
"""
