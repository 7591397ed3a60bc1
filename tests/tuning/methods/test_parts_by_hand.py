"""What tells two computations apart, and what is kept of one, by hand."""

import numpy as np
import pytest

from mjx_climb.files.dataset import OutputError
from tuning.methods import parts


def differing(stored, wanted):
    """Paths of mappings of the same keys, else the key itself, by recursion on the wanted one."""
    found = []
    for key in wanted:
        one, other = stored.get(key), wanted[key]
        if isinstance(one, dict) and isinstance(other, dict) and sorted(one) == sorted(other):
            found += [f"{key}.{each}" for each in differing(one, other)]
        elif one != other:
            found += [key]
    return found


def test_differences_are_named_as_far_down_as_both_have_the_same_keys():
    rng = np.random.default_rng(0)

    def drawn(depth):
        if depth == 0 or rng.uniform() < 0.3:
            return int(rng.integers(0, 2))
        keys = "abc"[: rng.integers(1, 4)]
        return {key: drawn(depth - 1) for key in keys}

    seen = set()
    for _ in range(300):
        one, other = {"x": drawn(2), "y": drawn(2)}, {"x": drawn(2), "y": drawn(2)}
        found = parts.differences(one, other)
        assert found == differing(one, other)
        seen |= {len(each.split(".")) for each in found}
        assert parts.differences(other, other) == []
    assert seen == {1, 2, 3}
    assert parts.differences({}, {"a": None, "b": 1}) == ["b"]


def test_parts_are_loaded_as_they_were_saved_until_they_are_cleared(tmp_path):
    kept = parts.Parts(tmp_path, {"a": 1})
    arrays = {"x": np.arange(3.0), "name": np.array(["a", "b"])}
    assert parts.identity_in(kept.folder) == {"a": 1} and kept.load(7) is None
    kept.save(7, arrays)
    again = parts.Parts(str(tmp_path), lambda: {"a": 1}).load(7)
    assert set(again) == set(arrays)
    for name, value in arrays.items():
        np.testing.assert_array_equal(again[name], value)
    for _ in range(2):  # nothing is there the second time
        parts.clear(tmp_path)
        assert not kept.folder.exists() and parts.identity_in(kept.folder) is None


def test_parts_of_another_computation_are_refused_with_what_to_do(tmp_path):
    """Keys that one of both has alone have no name."""
    parts.Parts(tmp_path, {"seed": 1, "axes": {"kp": 1}})
    for other, differs in (({"seed": 2, "axes": {"kp": 3}}, "seed, axes.kp"), ({"seed": 1}, "its keys")):
        with pytest.raises(OutputError) as refused:
            parts.Parts(tmp_path, other)
        assert str(refused.value) == (
            f"{tmp_path}: expected no unfinished computation but this one, got another that differs in {differs} "
            f"(repeat its command to finish it, remove {tmp_path}/parts, or choose another --out)"
        )
