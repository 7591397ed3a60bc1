"""Parts that are saved while the next ones are worked out."""

import json
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.files.dataset import OutputError
from tuning.methods import parts as module
from tuning.methods.parts import IDENTITY, Parts, identity_in
from tuning.searches import shards


@pytest.fixture
def slow(tmp_path, monkeypatch):
    """Parts that are written when they are allowed to be."""
    written, go, parts = module.write_in_place, threading.Event(), Parts(tmp_path, {"a": 1})

    def write(file, content):
        assert go.wait(20)
        written(file, content)

    monkeypatch.setattr(module, "write_in_place", write)
    parts.go = go
    return parts


def test_a_part_is_saved_beside_and_all_of_them_at_the_end(slow):
    with slow:
        slow.save(0, {"x": np.arange(2)})
        assert slow.load(0) is None  # and this goes on
        slow.go.set()
        slow.save(1, {"x": np.arange(3)})
    assert [len(slow.load(number)["x"]) for number in (0, 1)] == [2, 3]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_what_ends_the_work_takes_no_part_with_it(slow, error):
    with pytest.raises(error), slow:
        slow.save(0, {"x": np.arange(2)})
        threading.Timer(0.2, slow.go.set).start()
        raise error
    assert slow.load(0) is not None


@pytest.mark.parametrize("more", [0, 1])
def test_a_folder_that_cannot_be_written_is_said(tmp_path, monkeypatch, more):
    """When the next part is to be saved, or at the end."""
    parts, reached = Parts(tmp_path, {}), []
    (tmp_path / "parts").rename(tmp_path / "gone")
    (tmp_path / "parts").write_text("a file in its place")
    with pytest.raises(OutputError), parts:
        for number in range(1 + more):
            parts.save(number, {"x": np.arange(2)})
            reached.append(number)
    assert reached == [0]


def test_without_a_folder_nothing_is_saved():
    with Parts(None, lambda: pytest.fail("asked")) as parts:
        parts.save(0, {"x": np.arange(2)})
        assert parts.load(0) is None


def test_a_part_is_known_by_its_number_its_computation_and_every_bit(tmp_path):
    """One in place of another, one of another computation and one with any bit flipped count as not there."""
    ours, other = Parts(tmp_path / "ours", {"shard": [1, 2]}), Parts(tmp_path / "other", {"shard": [2, 2]})
    for number in (0, 1):
        ours.save(number, {"x": np.arange(2) + number})
    first, second = (ours.folder / f"part-00000{number}.npz" for number in (0, 1))
    shutil.copy(first, other.folder)
    assert other.load(0) is None
    with np.load(second) as arrays:  # any program may read one
        np.testing.assert_array_equal(arrays["x"], [1, 2])
    whole = first.read_bytes()
    for at in range(0, 8 * len(whole), 7):
        flipped = bytearray(whole)
        flipped[at // 8] ^= 1 << at % 8
        first.write_bytes(flipped)
        assert ours.load(0) is None, at
    for damaged in (second.read_bytes(), whole[: len(whole) // 2], b""):
        first.write_bytes(damaged)
        assert ours.load(0) is None
    assert ours.load(2) is None
    first.write_bytes(whole)
    np.testing.assert_array_equal(ours.load(0)["x"], [0, 1])


def test_a_part_that_would_run_code_is_not_read(tmp_path):
    parts = Parts(tmp_path, {"a": 1})
    parts.save(0, {"x": np.array([{}], object)})
    with pytest.raises(ValueError, match="allow_pickle=False"):
        parts.load(0)


def test_a_damaged_identity_is_said_in_one_line(tmp_path):
    file = Parts(tmp_path / "shard-1-of-1", {"shard": [1, 1], "a": 1.5}).folder / IDENTITY
    (tmp_path / "shard-1-of-1" / shards.FILE).write_text('{"again": ""}')
    assert len(shards.find([tmp_path])) == 1
    whole = file.read_text()
    numbers = [whole.replace("1.5", other) for other in ("1e400", "[" * 100_000, "1.25")]
    for damaged in (*numbers, json.dumps(json.loads(whole)["of"]), "[]", "\xff"):
        file.write_text(damaged)
        with pytest.raises(mc.ConfigError, match="expected the folder of a shard, got one that is damaged"):
            shards.find([tmp_path])
        with pytest.raises(OutputError, match="differs in shard, a "):
            Parts(tmp_path / "shard-1-of-1", {"shard": [1, 1], "a": 1.5})


def test_of_two_computations_that_begin_together_one_has_the_folder(tmp_path):
    """Often, as they meet at a barrier: threads that wait for each other by the folder alone."""
    for number in range(40):
        meeting = threading.Barrier(2)

        def begin(name, meeting=meeting, out=tmp_path / str(number)):
            def identity():
                meeting.wait(20)
                return {"name": name}

            try:
                return Parts(out, identity) and name
            except OutputError as error:
                assert "that differs in name" in str(error)
                return None

        with ThreadPoolExecutor(2) as pool:
            (winner,) = filter(None, pool.map(begin, "ab"))
        assert identity_in(tmp_path / str(number) / "parts") == {"name": winner}
