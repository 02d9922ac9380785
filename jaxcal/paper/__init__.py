"""The paper alone: its robot, datasets, exhibits and training runs.

``python -m jaxcal.paper`` (``make reproduce``) makes its figures, tables and claims
from our own runs. Nothing in the rest of jaxcal imports this package.
"""
