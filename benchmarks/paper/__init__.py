"""The tables of the paper, trained and tested by this package.

results = run_table(TABLES["blender-mtmt"], "nerf_synthetic", "out", device="cuda", rows=["analytic", "moment"])
print(text(results))
"""

from .protocols import ROWS, STARRED_ROWS, TABLES, Data, Row, Table
from .published import PUBLISHED, Number, Published
from .report import Results, as_dict, markdown, text
from .run import run_table

__all__ = [
    "PUBLISHED",
    "ROWS",
    "STARRED_ROWS",
    "TABLES",
    "Data",
    "Number",
    "Published",
    "Results",
    "Row",
    "Table",
    "as_dict",
    "markdown",
    "run_table",
    "text",
]
