"""Files that are read and replaced: regular ones only, complete or not at all."""

import os
import stat
import sys
import threading
import time

import numpy as np
import pytest
from systems import LINKS, MODES, PIPES

import apt_evap as ae
from apt_evap._common.files import FileError, open_for_reading, read_small_file, replace_file


def names(folder):
    return sorted(item.name for item in folder.iterdir())


def write(path, content=b"new"):
    with replace_file(path) as file:
        file.write(content)


# ---- reading -------------------------------------------------------------------------------------------------------


@PIPES
@pytest.mark.parametrize("name", ["a.epos", "a.pos", "a.apt", "a.raw", "a.rrng", "a.npz", "a.h5"])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path, name):
    os.mkfifo(tmp_path / name)
    reader = ae.io.read_ranges if name.endswith("rrng") else ae.read
    with pytest.raises(FileError, match=rf"cannot read .*{name}': Not a regular file"):
        reader(tmp_path / name)


def test_a_folder_is_refused(tmp_path):
    with pytest.raises(FileError, match=r"Is a directory"), open_for_reading(tmp_path):
        pass


@LINKS
def test_links_to_regular_files(tmp_path):
    (tmp_path / "a").write_bytes(b"content")
    (tmp_path / "link").symlink_to("a")
    with open_for_reading(tmp_path / "link") as file:
        assert file.read() == b"content"


def test_the_size_of_a_small_file_is_bounded(tmp_path):
    with open(tmp_path / "large.toml", "wb") as file:
        file.truncate(6 << 30)
    with pytest.raises(FileError, match=r"large\.toml' has more than 1000 bytes, expected a TOML file"):
        read_small_file(tmp_path / "large.toml", 1000, "a TOML file")


# ---- writing -------------------------------------------------------------------------------------------------------


def test_two_threads_and_one_file(tmp_path):
    """Whole files of one or the other."""
    n = 20_000
    both = [ae.Hits(positions=np.full((n, 3), float(k)), mass_to_charge=np.full(n, float(k))) for k in (1, 2)]
    path, end, failed = tmp_path / "o.pos", threading.Event(), []
    ae.write(path, both[0])

    def go_on(hits):
        try:
            while not end.is_set():
                ae.write(path, hits)
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=go_on, args=(hits,)) for hits in both]
    for thread in threads:
        thread.start()
    try:
        for _ in range(100):
            read = ae.read(path)
            assert len(read) == n and len(np.unique(read.positions)) == 1
    finally:
        end.set()
        for thread in threads:
            thread.join()
    assert failed == [] and names(tmp_path) == ["o.pos"]


@MODES
@pytest.mark.parametrize("mode", [0o664, 0o600, 0o444])
def test_an_overwritten_file_keeps_its_mode(tmp_path, mode):
    path = tmp_path / "o.pos"
    path.write_bytes(b"old")
    path.chmod(mode)
    write(path)
    assert path.read_bytes() == b"new" and stat.S_IMODE(path.stat().st_mode) == mode


def test_a_new_file_has_the_usual_mode(tmp_path):
    (tmp_path / "usual").touch()
    write(tmp_path / "new")
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "usual").stat().st_mode


@PIPES
@LINKS
def test_outputs_that_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").write_bytes(b"old")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder").mkdir()
    before = names(tmp_path)
    for name, reason in (
        ("pipe", "Not a regular file"),
        ("folder", "Is a directory"),
        ("file/a.pos", "Not a directory"),
        ("loop", "Too many levels of symbolic links"),
        ("n" * 300, "File name too long"),
        ("nowhere/a", "No such file"),
    ):
        with pytest.raises(FileError, match=rf"cannot write .*: {reason}"):
            write(tmp_path / name)
    assert names(tmp_path) == before


@LINKS
def test_long_names_and_links(tmp_path):
    name = "n" * 250
    write(tmp_path / name)
    (tmp_path / "link").symlink_to(name)
    write(tmp_path / "link", b"newer")
    assert (tmp_path / name).read_bytes() == b"newer" and (tmp_path / "link").is_symlink()


def test_errors_leave_nothing_behind(tmp_path):
    for error in (OSError("full"), RuntimeError("no"), KeyboardInterrupt()):
        with pytest.raises((FileError, RuntimeError, KeyboardInterrupt)), replace_file(tmp_path / "a.png"):
            raise error
    assert names(tmp_path) == []


def test_what_a_killed_process_left_is_removed(tmp_path):
    left, others = f".a.png.{'0' * 16}.part", [".a.png.part", ".a.png.old.part", f".b.png.{'0' * 16}.part"]
    for name in (left, *others):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time.time() - 4000,) * 2)
    fresh = tmp_path / f".a.png.{'2' * 16}.part"
    fresh.touch()
    write(tmp_path / "a.png")
    assert names(tmp_path) == sorted(["a.png", fresh.name, *others])


def test_a_file_is_closed_before_it_is_renamed(tmp_path, monkeypatch):
    """Windows renames no open file."""
    opened, replace = [], os.replace

    def check(source, target):
        assert opened[0].closed
        replace(source, target)

    monkeypatch.setattr(os, "replace", check)
    with replace_file(tmp_path / "a.png") as file:
        opened.append(file)
    assert names(tmp_path) == ["a.png"]


def test_a_file_that_is_read_is_renamed_later_on_windows(tmp_path, monkeypatch):
    tries, replace = [], os.replace

    def refuse(source, target):
        tries.append(target)
        if len(tries) < 3:
            raise PermissionError(13, "Access is denied")
        replace(source, target)

    monkeypatch.setattr(os, "replace", refuse)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(FileError, match=r"cannot write .*a\.png': Access is denied"):
        write(tmp_path / "a.png")
    assert len(tries) == 1 and names(tmp_path) == []
    monkeypatch.setattr(sys, "platform", "win32")
    write(tmp_path / "a.png")
    assert len(tries) == 3 and names(tmp_path) == ["a.png"]


def test_a_full_disk_is_one_sentence_and_leaves_nothing(tmp_path):
    """A limit on the size of files, which meets a write as a full disk does."""
    resource = pytest.importorskip("resource")  # not on Windows
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, before[1]))
    try:
        for n_bytes in (6000, 6_000_000):  # written at the end, or while the block runs
            with pytest.raises(FileError, match=r"cannot write .*a\.png': File too large"):
                write(tmp_path / "a.png", bytes(n_bytes))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert names(tmp_path) == []
