"""The paper's figures, tables and claims, from our own runs: ``make reproduce``."""
