"""The schema of fixes: one set of columns in the forms of pandas, Arrow and Spark."""

import pyarrow as pa
import pytest

from optloc import InvalidProblem
from optloc.partitions import fix_schema
from optloc.partitions.fixed_columns import FIX_COLUMNS, frame_of


def test_all_forms_have_the_same_columns():
    names = list(FIX_COLUMNS)
    assert list(fix_schema().columns) == names
    assert fix_schema("arrow").names == names
    assert [part.split()[0] for part in fix_schema("spark").split(", ")] == names
    assert pa.Table.from_pandas(fix_schema(), preserve_index=False).schema.types == [
        pa.large_string() if kind == pa.string() else kind for kind in fix_schema("arrow").types
    ]
    with pytest.raises(InvalidProblem, match="there is no form 'sprak'"):
        fix_schema("sprak")


def test_missing_columns_have_the_values_of_their_type():
    frame = frame_of({"x": [1.0, 2.0], "other": [3, 4]}, 2)
    assert frame.dtypes.equals(fix_schema().dtypes)
    assert frame["x"].tolist() == [1.0, 2.0]
    assert frame["y"].isna().all()
    assert frame["status"].tolist() == ["", ""]
    assert frame["dof"].tolist() == [0, 0]
