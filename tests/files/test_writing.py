"""What stands where a file is to be written: a link is written through, what is no regular file is never replaced."""

import os
import stat
import threading

import numpy as np
import pytest

from mjx_climb.files.writing import OutputError, write_text_atomically
from mjx_climb.viz import rendering

WRITERS = {
    "text": lambda path: write_text_atomically(path, "new"),
    "video": lambda path: rendering.encode(path, iter([np.zeros((64, 64, 3), np.uint8)]), 25, (64, 64)),
}


@pytest.fixture(params=WRITERS)
def write(request):
    return WRITERS[request.param]


@pytest.mark.parametrize("there", [True, False])
def test_a_link_is_written_through(write, there, tmp_path):
    (tmp_path / "far").mkdir()
    target, link = tmp_path / "far" / "target", tmp_path / "link"
    if there:
        target.write_text("old")
    (tmp_path / "between").symlink_to("far/target")
    link.symlink_to("between")
    assert write(link) == link
    assert link.is_symlink() and (tmp_path / "between").is_symlink()
    assert target.read_bytes() not in (b"old", b"")
    assert sorted(os.listdir(tmp_path)) == ["between", "far", "link"] and os.listdir(tmp_path / "far") == ["target"]


def test_a_pipe_is_written_to_and_stays(tmp_path):
    pipe, read = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()), daemon=True)
    reader.start()
    write_text_atomically(pipe, "new")
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    reader.join()
    assert read == [b"new"] and os.listdir(tmp_path) == ["pipe"]


def test_impossible_places_are_refused_in_one_line(write, tmp_path):
    (tmp_path / "circle").symlink_to("circle")
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    for name in ("circle", "folder", "file/inside.txt", "nul\0"):
        shown = name.replace("\0", r"\\x00")
        with pytest.raises(OutputError, match=f"^.+{shown}: expected a file that can be written, got .+$") as caught:
            write(tmp_path / name)
        assert "\n" not in str(caught.value)
    assert (tmp_path / "circle").is_symlink() and sorted(os.listdir(tmp_path)) == ["circle", "file", "folder"]
