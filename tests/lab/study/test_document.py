"""Tables of a study file: strict types, the schema, and standard deviations in SI units."""

import numpy as np
import pytest
from pydantic import ValidationError

from optloc.base.errors import InvalidProblem
from optloc.base.units import SPEED_OF_LIGHT
from optloc.lab.study.document import ErrorTable, MethodTable, OutlierTable, TruthTable, sigma_of, study_schema


@pytest.mark.parametrize(
    ("kind", "amount", "wanted"),
    [
        ("tdoa", "3 m", 3.0),
        ("tdoa", "30 ns", 30e-9 * SPEED_OF_LIGHT),
        ("azimuth", "5 mrad", 5e-3),
        ("groa", "1 dB", np.log(10.0) / 20.0),  # amplitudes: 20 log10 of a ratio
    ],
)
def test_deviations_are_in_units_of_their_kind(kind, amount, wanted):
    assert sigma_of(kind, amount, "noise") == pytest.approx(wanted, rel=1e-12)


def test_a_deviation_is_positive():
    with pytest.raises(InvalidProblem, match="noise: '0 m' is not positive"):
        sigma_of("range", "0 m", "noise")


def test_text_is_no_number_and_unknown_keys_are_refused():
    with pytest.raises(ValidationError, match="share"):
        OutlierTable.model_validate({"share": "0.1", "size": 3.0})
    with pytest.raises(ValidationError, match="hight"):
        TruthTable.model_validate({"kind": "area", "hight": 3.0})
    assert MethodTable.model_validate({"method": ["auto", "gtrs"]}).start == "centre"


def test_the_schema_describes_every_key():
    schema = study_schema()
    assert schema["properties"]["format"]["const"] == 1
    for name, table in schema["$defs"].items():
        for key, value in table["properties"].items():
            assert value.get("description"), (name, key)
    assert set(schema["$defs"]["ErrorTable"]["properties"]) == set(ErrorTable.model_fields)
