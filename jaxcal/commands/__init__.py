"""The console command ``jaxcal``: one module for each of its commands."""

import os

from jaxcal.commands.main import main

# jaxlib 0.10.1 logs an error for each program that it takes from the disk cache where
# the processor has hints that XLA does not list as features; the programs are right.
# Read when JAX is loaded.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

__all__ = ["main"]
