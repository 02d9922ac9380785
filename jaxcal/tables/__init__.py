"""Tables: one reader for files and frames, one decision for each column.

A column that has a name is never read by its place; what is not read, or could be meant
otherwise, is said in one line.
"""

from jaxcal.tables.decisions import Decision
from jaxcal.tables.files import csv_text, parse, read_table
from jaxcal.tables.frames import (
    header_of,
    inputs_of,
    names_in,
    of_frame,
    outputs_of,
    say_order,
    table_of_frame,
)
from jaxcal.tables.names import COMMANDS, MEASURED, columns_by_name
from jaxcal.tables.table import Table

__all__ = [
    "COMMANDS",
    "MEASURED",
    "Decision",
    "Table",
    "columns_by_name",
    "csv_text",
    "header_of",
    "inputs_of",
    "names_in",
    "of_frame",
    "outputs_of",
    "parse",
    "read_table",
    "say_order",
    "table_of_frame",
]
