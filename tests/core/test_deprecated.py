"""Names that go still work, and say once for each place what replaces them."""

import inspect
import warnings

import pytest

from recon.core.deprecated import deprecated

pytestmark = pytest.mark.portable


@deprecated(since="1.1", use="twice")
def double(x: int) -> int:
    """Return 2x."""
    return 2 * x


@deprecated(since="1.1", use="voxel_m", keyword="size")
def thin(points: int, *, voxel_m: float = 0.1) -> tuple[int, float]:
    return points, voxel_m


def test_a_replaced_function_works_names_its_caller_and_what_to_use():
    message = "double is deprecated since recon 1.1: use twice"
    with pytest.warns(DeprecationWarning, match=message) as warned:
        assert double(3) == 6
    assert [one.filename for one in warned] == [__file__]


def test_a_replaced_keyword_is_passed_on_by_its_new_name():
    with pytest.warns(DeprecationWarning, match=r"thin\(size=…\) is .* use voxel_m=…"):
        assert thin(5, size=0.2) == (5, 0.2)
    with pytest.raises(TypeError, match="both size and voxel_m: give voxel_m alone"):
        thin(5, size=0.2, voxel_m=0.3)


def test_the_new_keyword_warns_of_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert thin(5, voxel_m=0.2) == (5, 0.2)


def test_each_place_that_calls_warns_once():
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("default")
        for _ in range(3):
            double(1)
        double(2)
    assert len(seen) == 2


def test_the_docstring_says_it_and_the_signature_stays():
    assert inspect.getdoc(double).splitlines()[0] == "Return 2x."
    assert "Deprecated: double is deprecated since recon 1.1: use twice." in double.__doc__
    assert "Deprecated: thin(size=…)" in thin.__doc__
    assert [*inspect.signature(thin).parameters] == ["points", "voxel_m"]
