"""The console command ``jaxcal``: one module for each of its commands."""

from jaxcal.commands.main import main

__all__ = ["main"]
