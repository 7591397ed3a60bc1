"""What stands where a file is to be written: a link is written through, what is no regular file is never replaced."""

import os
import socket
import stat
import subprocess
import threading

import numpy as np
import pytest

from mjx_climb.child_process import PATIENCE, read_apart
from mjx_climb.files.locks import alone, is_held, refused
from mjx_climb.files.writing import OutputError, check_folder, write_in_place, write_text_atomically
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


def test_a_socket_is_refused_and_stays(tmp_path):
    with socket.socket(socket.AF_UNIX) as there:
        there.bind(str(tmp_path / "socket"))
        with pytest.raises(OutputError, match=r"socket: expected a file that can be written, got no such device or"):
            write_text_atomically(tmp_path / "socket", "new")
        assert stat.S_ISSOCK((tmp_path / "socket").stat().st_mode) and os.listdir(tmp_path) == ["socket"]


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


def test_a_file_is_written_in_place_of_a_link_wherever_that_leads(tmp_path):
    (tmp_path / "target").write_text("old")
    for name, target in (("link", "target"), ("dangling", "nowhere"), ("circle", "circle"), ("file", None)):
        if target is not None:
            (tmp_path / name).symlink_to(target)
        write_in_place(tmp_path / name, b"new")
        assert (tmp_path / name).read_bytes() == b"new" and not (tmp_path / name).is_symlink()
    assert (tmp_path / "target").read_text() == "old"
    assert sorted(os.listdir(tmp_path)) == ["circle", "dangling", "file", "link", "target"]


def test_a_folder_is_checked_however_deep_it_is_to_be_made_and_nothing_is_left_in_it(tmp_path):
    check_folder(tmp_path / "a" / "b" / "c")
    (tmp_path / "file").write_text("")
    for wrong in ("file", "file/below", "file/far/below"):
        with pytest.raises(
            OutputError, match=rf"{wrong}: expected a folder that can be written to, got not a directory"
        ):
            check_folder(tmp_path / wrong)
    assert os.listdir(tmp_path) == ["file"]


def test_a_folder_has_one_holder_at_a_time(tmp_path):
    for wait in (True, False):
        assert not is_held(tmp_path)
        with alone(tmp_path, wait=wait):
            assert is_held(tmp_path)
            with pytest.raises(BlockingIOError), alone(tmp_path, wait=False):
                pytest.fail("two have it")
        assert not is_held(tmp_path)
    assert not is_held(tmp_path / "gone")
    with pytest.raises(OutputError, match=rf"^{tmp_path}: expected a folder that can be written to, got no such fil"):
        with refused(tmp_path), alone(tmp_path / "gone"):
            pass


def test_a_large_file_has_more_time_to_be_read_apart(tmp_path, monkeypatch):
    asked = []

    def run(command, **how):
        asked.append((command[1:], how["timeout"]))
        return subprocess.CompletedProcess(command, codes.pop(0))

    monkeypatch.setattr(subprocess, "run", run)
    (tmp_path / "small").write_bytes(b"")
    with (tmp_path / "large").open("wb") as file:
        file.truncate(40_000_000)
    codes = [0, 3, -11]
    assert read_apart("code", tmp_path / "small").returncode == 0
    assert read_apart("code", tmp_path / "large").returncode == 3  # it says why itself
    with pytest.raises(ValueError, match=r"^a damaged one$"):
        read_apart("code", tmp_path / "small")
    small, large = ["-c", "code", str(tmp_path / "small")], ["-c", "code", str(tmp_path / "large")]
    assert asked == [(small, PATIENCE), (large, PATIENCE + 2.0), (small, PATIENCE)]
