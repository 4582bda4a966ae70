"""Limits of fields: checks, errors, the reference and options derive from one declaration."""

import math
from typing import Annotated, Literal

import click
import msgspec
import pytest
from ertis_cli._parameter_types import ranged
from ertis_cli._toml_reference import DOCUMENTS, reference

from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings import Accuracy, Air, Array, Passive, Processing, Recording
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import Limits, checker

TABLES = (Accuracy, Air, Array, Passive, Processing, Recording)


class Row(TomlTable, frozen=True, kw_only=True):
    """Table with a field of each kind."""

    level: Annotated[float, Limits(-1.0, 2.0)] = 0.0
    count: Annotated[int, Limits(1)] = 1
    span: Annotated[tuple[float, float], Limits(0.0, 9.0)] | None = None
    place: tuple[Annotated[float, Limits(-5.0, 5.0, "{} x")], float] = (0.0, 0.0)
    many: tuple[Annotated[float, Limits(0.0, 1.0)], ...] = ()
    mode: Literal["a", "b"] | tuple[Annotated[int, Limits(0, 3)], ...] = "a"


@pytest.mark.parametrize(
    ("given", "stated"),
    [
        ({"level": 2.1}, "row.level is 2.1; use a number from -1 to 2"),
        ({"level": math.nan}, "row.level is nan; use a finite number"),
        ({"count": 0}, "row.count is 0; use a whole number of at least 1"),
        ({"span": (1, 10)}, "row.span is 10; use a number from 0 to 9"),
        ({"span": (2, 1)}, "row.span runs from 2 to 1; use the smaller number first"),
        ({"place": (6, 99)}, "row.place x is 6; use a number from -5 to 5"),
        ({"many": (0.5, 1.5)}, "row.many[1] is 1.5; use a number from 0 to 1"),
        ({"mode": "c"}, "row.mode 'c' is unknown; known are a, b"),
        ({"mode": (1, 4)}, "row.mode[1] is 4; use a whole number from 0 to 3"),
    ],
)
def test_values_beyond_the_limits_are_refused(given, stated):
    with pytest.raises(ArgumentError) as caught:
        Row(**given)
    assert str(caught.value) == stated


def test_limits_themselves_are_accepted():
    row = Row(level=2, count=10**9, span=(0, 9), place=(-5, 1e9), many=(0, 1), mode=(0, 3))
    assert (row.level, row.span, row.many, row.mode) == (2.0, (0.0, 9.0), (0.0, 1.0), (0, 3))
    assert Row(span=None).span is None


@pytest.mark.parametrize("kind", [float, str | None, tuple[float, float], dict[str, float]])
def test_type_without_limits_has_no_check(kind):
    assert checker(kind) is None


def test_option_has_the_limits_of_its_field():
    for limits, kind in ((Limits(1, 8), click.IntRange), (Limits(0.5, 8.0), click.FloatRange)):
        option = ranged(limits)
        assert isinstance(option, kind)
        assert (option.min, option.max) == limits[:2]
    assert ranged(Limits(1)).max is None


def test_reference_states_the_limits_of_every_field():
    shapes = {
        (section.header.strip("[]"), key.name): key.shape
        for document in DOCUMENTS
        for section in reference(document)
        for key in section.keys
    }
    for table in TABLES:
        for field in msgspec.structs.fields(table):
            if isinstance(limits := next(iter(getattr(field.type, "__metadata__", ())), None), Limits):
                assert shapes[table.label(), field.name].endswith(str(limits))
    assert shapes["recording", "n_samples"] == "whole number from 1 to 268435456"
    assert "from" not in shapes["platform", "waypoints"]  # times have no limits
