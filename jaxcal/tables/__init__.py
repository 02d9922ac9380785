"""Tables: one reader for files and frames, one decision for each column."""

from jaxcal.tables.decisions import COMMANDS, MEASURED, Decision, columns_by_name, say
from jaxcal.tables.files import parse, read_table
from jaxcal.tables.frames import (
    by_name,
    header_of,
    inputs_of,
    limits_of_frame,
    names_in,
    of_frame,
    outputs_of,
    require_unnamed,
    say_order,
    table_of_frame,
)
from jaxcal.tables.table import Table

__all__ = [
    "COMMANDS",
    "MEASURED",
    "Decision",
    "Table",
    "by_name",
    "columns_by_name",
    "header_of",
    "inputs_of",
    "limits_of_frame",
    "names_in",
    "of_frame",
    "outputs_of",
    "parse",
    "read_table",
    "require_unnamed",
    "say",
    "say_order",
    "table_of_frame",
]
