"""The columns of a partition of fixes: always the same names and types, whatever the readings are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from optloc.base.errors import InvalidProblem, nearest

if TYPE_CHECKING:
    import pandas as pd

_TEXT, _NUMBER, _WHOLE, _FLAG = "string", "double", "bigint", "boolean"


def _numbers(names: str) -> dict[str, str]:
    """Return columns of numbers by name."""
    return dict.fromkeys(names.split(), _NUMBER)


FIX_COLUMNS: Mapping[str, str] = {
    "epoch": _TEXT,
    "time": _NUMBER,
    "target": _TEXT,
    "status": _TEXT,
    "reason": _TEXT,
    "findings": _TEXT,
    "proof": _TEXT,
    **_numbers("x y z sigma_x sigma_y sigma_z cov_xx cov_xy cov_xz cov_yy cov_yz cov_zz"),
    **_numbers("lat_deg lon_deg height cov_ee cov_en cov_eu cov_nn cov_nu cov_uu"),
    **_numbers("emission_s sigma_emission_s cost"),
    "dof": _WHOLE,
    "p_value": _NUMBER,
    "unchecked": _FLAG,
    "alternatives": _WHOLE,
}
"""Types of the columns in the words of SQL: metres, seconds and degrees; NaN marks a missing number."""

_DTYPES = {_TEXT: "string", _NUMBER: "float64", _WHOLE: "int64", _FLAG: "bool"}
# Values of columns that a table of fixes does not have.
_EMPTY: dict[str, Any] = {_TEXT: "", _NUMBER: np.nan, _WHOLE: 0, _FLAG: False}

Form = Literal["pandas", "arrow", "spark"]


def fix_schema(form: Form = "pandas") -> Any:
    """Return the schema of the tables that `optloc.fix_table` returns.

    Parameters
    ----------
    form : "pandas", "arrow" or "spark"
        An empty data frame (`meta` of Dask), a schema of pyarrow, or text for `applyInPandas` of Spark.

    Returns
    -------
    pandas.DataFrame, pyarrow.Schema or str

    Raises
    ------
    InvalidProblem
        For another form.

    Examples
    --------
    >>> import optloc
    >>> optloc.partitions.fix_schema("spark")[:45]
    'epoch string, time double, target string, sta'
    """
    forms = {"pandas": lambda: frame_of({}, 0), "arrow": _arrow, "spark": _spark}
    if form not in forms:
        raise InvalidProblem(f"there is no form {form!r}", "form", nearest(str(form), list(forms)))
    return forms[form]()


def _spark() -> str:
    """Return the schema as text of SQL."""
    return ", ".join(f"{name} {kind}" for name, kind in FIX_COLUMNS.items())


def _arrow() -> Any:
    """Return the schema of pyarrow."""
    import pyarrow as pa

    types = {_TEXT: pa.string(), _NUMBER: pa.float64(), _WHOLE: pa.int64(), _FLAG: pa.bool_()}
    return pa.schema([(name, types[kind]) for name, kind in FIX_COLUMNS.items()])


def frame_of(columns: Mapping[str, Any], count: int) -> pd.DataFrame:
    """Return columns (n,) as a data frame with the fixed schema; other columns are left out.

    `count` is the number of rows n. Missing columns are NaN, empty text, zero or False.
    """
    import pandas as pd

    found = {
        name: pd.Series(columns[name] if name in columns else [_EMPTY[kind]] * count, dtype=_DTYPES[kind])
        for name, kind in FIX_COLUMNS.items()
    }
    return pd.DataFrame(found)


def arrow_of(frame: pd.DataFrame) -> Any:
    """Return fixes in the fixed schema as a table of pyarrow; missing numbers are null."""
    import pyarrow as pa

    table = pa.Table.from_pandas(frame, schema=_arrow(), preserve_index=False)
    # Without the description of pandas, which names its version: files of all workers are equal.
    return table.replace_schema_metadata()
