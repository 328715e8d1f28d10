"""Files that are whole or not there: killed writers, several at once, links and permissions."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from prefmpc import _files
from prefmpc._files import atomic_write

OLD, NEW = b"what was saved before", b"what is saved now"


def start(code, *arguments):
    """Run ``code`` in a process of its own that imports one module, and not JAX."""
    head = f"import sys, time; sys.path.append({str(Path(_files.__file__).parent)!r})\n"
    head += "from _files import atomic_write\n"
    command = [sys.executable, "-S", "-c", head + code, *map(str, arguments)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def finish(process):
    process.kill()
    process.communicate()


def save(path, content=NEW, overwrite=True):
    with atomic_write(path, overwrite=overwrite) as file:
        file.write(content)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "data.npz"
    path.write_bytes(OLD)
    return path


def names(folder):
    return sorted(p.name for p in folder.iterdir())


COMPETE = """
for line in sys.stdin:
    try:
        with atomic_write(line.strip(), overwrite=False) as file:
            file.write(sys.argv[1].encode())
            file.flush()
            time.sleep(0.005)
        print("won", flush=True)
    except FileExistsError as error:
        assert "overwrite=True" in str(error)
        print("lost", flush=True)
"""


def test_of_several_that_save_at_once_one_succeeds(tmp_path):
    writers = [start(COMPETE, i) for i in range(3)]
    for i in range(20):
        path = tmp_path / f"{i}.npz"
        for writer in writers:
            writer.stdin.write(f"{path}\n")
        for writer in writers:
            writer.stdin.flush()
        said = [writer.stdout.readline().strip() for writer in writers]
        assert sorted(said) == ["lost", "lost", "won"]
        assert path.read_text() == str(said.index("won"))
    for writer in writers:
        finish(writer)
    assert len(names(tmp_path)) == 20


STOP_HALFWAY = """
with atomic_write(sys.argv[1], overwrite=True) as file:
    file.write(b"half")
    file.flush()
    print("there", flush=True)
    time.sleep(60)
"""


def test_what_killed_writers_leave_is_removed_and_what_live_ones_write_is_not(path):
    other = path.with_name("data.npz.copy")
    save(other, OLD)
    writers = [start(STOP_HALFWAY, path) for _ in range(20)] + [start(STOP_HALFWAY, other)]
    assert {writer.stdout.readline() for writer in writers} == {"there\n"}
    assert len(names(path.parent)) == 2 + 21  # nobody has removed another's
    for writer in writers:
        finish(writer)
    assert path.read_bytes() == OLD
    save(path)
    assert path.read_bytes() == NEW
    left = names(path.parent)
    assert left[1:] == ["data.npz", "data.npz.copy"]
    assert left[0].startswith(".data.npz.copy.")  # of another file
    save(other)
    assert names(path.parent) == left[1:]


REPLACE_FOR_EVER = """
while True:
    for letter in b"AB":
        with atomic_write(sys.argv[1], overwrite=True) as file:
            for _ in range(10):
                file.write(bytes([letter]) * 10_000)
            print("more", flush=True)
"""


def test_a_file_is_whole_whenever_its_writer_is_killed(path):
    for i in range(20):
        writer = start(REPLACE_FOR_EVER, path)
        assert writer.stdout.readline()
        time.sleep(0.001 * i)
        finish(writer)
        content = path.read_bytes()
        assert content in (OLD, b"A" * 100_000, b"B" * 100_000)
    save(path)
    assert names(path.parent) == ["data.npz"]


def test_two_threads_of_one_process_do_not_remove_each_others(path):
    with atomic_write(path, overwrite=True) as slow:
        save(path)
        slow.write(OLD)
    assert path.read_bytes() == OLD
    assert names(path.parent) == ["data.npz"]


def test_a_new_file_that_is_taken_for_a_leftover_is_created_again(path, monkeypatch):
    lock, taken = _files.fcntl.flock, []

    def slow(file, how):
        if not taken:
            taken.append(file.name)
            os.unlink(file.name)
        return lock(file, how)

    monkeypatch.setattr(_files.fcntl, "flock", slow)
    save(path)
    assert path.read_bytes() == NEW
    assert taken


@pytest.mark.parametrize("mode", [0o600, 0o644, 0o664, 0o444, 0o755])
def test_a_replaced_file_keeps_its_permissions(path, mode):
    path.chmod(mode)
    with atomic_write(path, overwrite=True) as file:
        during = stat.S_IMODE(os.stat(file.name).st_mode)
        assert not during & ~mode  # nobody can read what was private
        file.write(NEW)
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert path.read_bytes() == NEW


def test_a_new_file_has_ordinary_permissions_without_touching_the_umask(tmp_path, monkeypatch):
    before = os.umask(0o027)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "umask", None)  # it belongs to all threads
            save(tmp_path / "new.npz")
        (tmp_path / "plain").touch()
    finally:
        os.umask(before)
    modes = {stat.S_IMODE(p.stat().st_mode) for p in tmp_path.iterdir()}
    assert modes == {0o640}


@pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() != 0, reason="only root gives files away")
def test_a_replaced_file_keeps_its_owner(path):
    os.chown(path, 12345, 12346)
    save(path)
    assert (path.stat().st_uid, path.stat().st_gid) == (12345, 12346)


def test_a_symbolic_link_stays_one(path, tmp_path):
    folder = tmp_path / "links"
    folder.mkdir()
    link = folder / "link.npz"
    link.symlink_to("../data.npz")
    with pytest.raises(FileExistsError, match=r"link\.npz exists"):
        save(link, overwrite=False)
    assert path.read_bytes() == OLD
    save(link)
    assert os.readlink(link) == "../data.npz"
    assert path.read_bytes() == NEW
    assert (names(folder), names(tmp_path)) == (["link.npz"], ["data.npz", "links"])


def test_a_link_to_nowhere_is_followed_only_on_demand(tmp_path):
    link, target = tmp_path / "link.npz", tmp_path / "target.npz"
    link.symlink_to(target)
    with pytest.raises(FileExistsError, match="overwrite=True"):
        save(link, overwrite=False)
    assert names(tmp_path) == ["link.npz"]
    save(link)
    assert link.is_symlink()
    assert target.read_bytes() == NEW


def test_the_folder_is_written_to_the_disk_after_the_file(path, monkeypatch):
    seen, sync = [], os.fsync

    def watch(handle):
        seen.append(stat.S_ISDIR(os.fstat(handle).st_mode))
        sync(handle)

    monkeypatch.setattr(os, "fsync", watch)
    save(path)
    assert seen == [False, True]


def no_links(*args, **options):
    raise OSError(errno.EPERM, "no hard links here")


def test_a_file_system_without_hard_links(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "link", no_links)
    path = tmp_path / "new.npz"

    def overtaken():
        with atomic_write(path, overwrite=False) as file:
            file.write(OLD)
            save(path, overwrite=False)  # another process is faster

    with pytest.raises(FileExistsError, match="overwrite=True"):
        overtaken()
    assert path.read_bytes() == NEW
    assert names(tmp_path) == ["new.npz"]
    monkeypatch.setattr(os, "replace", no_links)
    with pytest.raises(OSError, match="no hard links"):
        save(tmp_path / "other.npz", overwrite=False)
    assert names(tmp_path) == ["new.npz"]


def leftover(path, computer, age):
    left = path.with_name(f".data.npz.{computer}-0123abcd.part")
    left.write_bytes(b"half")
    os.utime(left, (time.time() - age,) * 2)
    return left


@pytest.mark.parametrize("locks", [True, False])
def test_without_a_lock_that_can_be_trusted_a_leftover_must_be_a_day_old(path, monkeypatch, locks):
    monkeypatch.setattr(_files, "HAS_LOCKS", locks)
    other = "0" * 8 if locks else _files._computer()
    young = leftover(path, other, 3600)
    save(path)
    assert young.exists()
    leftover(path, other, 100_000)
    save(path)
    assert path.read_bytes() == NEW
    assert names(path.parent) == ["data.npz"]


def test_nothing_but_leftovers_is_removed(path):
    mine = [".data.npz.part", ".data.npz.backup.part", "data.npz.0123abcd-0123abcd.part"]
    for name in mine:
        path.with_name(name).write_bytes(OLD)
    save(path)
    assert names(path.parent) == sorted([*mine, "data.npz"])


@pytest.mark.parametrize("name", ["x" * 251 + ".npz", "ß" * 125 + ".npz", "[a*]?.npz", "a b\n.npz"])
def test_any_name_will_do(tmp_path, name):
    save(tmp_path / name, OLD, overwrite=False)
    left = start(STOP_HALFWAY, tmp_path / name)
    assert left.stdout.readline()
    finish(left)
    save(tmp_path / name)
    assert names(tmp_path) == [name]


def test_what_cannot_be_written_is_said_with_the_path_given(path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"cannot write to the folder.*nowhere/data.npz"):
        save(path.parent / "nowhere" / "data.npz")
    with pytest.raises(OSError, match="is not a file"):
        save(path.parent)
    loop = path.with_name("loop.npz")
    loop.symlink_to(loop)
    with pytest.raises(OSError, match=r"loop\.npz"):
        save(loop)
    assert loop.is_symlink()

    def read_only(*args, **options):
        raise PermissionError(errno.EACCES, "Permission denied", "a hidden name")

    monkeypatch.setattr(os, "open", read_only)
    with pytest.raises(PermissionError, match=r"\(Permission denied\): '.*/data\.npz'"):
        save(path)
    assert path.read_bytes() == OLD


@pytest.mark.parametrize("stop", [OSError("full"), KeyboardInterrupt()], ids=["disk", "ctrl-c"])
@pytest.mark.parametrize("overwrite", [True, False])
def test_an_interrupted_write_leaves_nothing(path, stop, overwrite):
    target = path if overwrite else path.with_name("new.npz")

    def interrupted():
        with atomic_write(target, overwrite=overwrite) as file:
            file.write(NEW)
            raise stop

    with pytest.raises(type(stop)):
        interrupted()
    assert names(path.parent) == ["data.npz"]
    assert path.read_bytes() == OLD
