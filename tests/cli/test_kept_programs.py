"""Compiled programs are kept between commands, safely, and change no bit of a result."""

import json
import os
import stat
import subprocess
import sys

import pytest
from helpers import python

from jaxtank.xla import program_cache as kept
from tuning.cli.main import main

RUN = ["simulate", "cascaded/pi", "--json", "--dt", "8"]


def command(folder, *words):
    """Run the command in a process of its own with programs in `folder`; returns (out, err)."""
    hidden = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    env = {n: v for n, v in os.environ.items() if n not in hidden}
    env |= {"JAXTANK_CACHE": str(folder), "JAX_LOG_COMPILES": "0"}
    done = subprocess.run(
        [sys.executable, "-m", "jaxtank", *words], capture_output=True, text=True, env=env
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def measures(out):
    """What a run printed, without the time it took."""
    return {n: v for n, v in json.loads(out).items() if n in ("measures", "parameters")}


def entries(folder):
    return sorted(folder.glob(f"*/*{kept.ENTRY}"))


@pytest.mark.slow
def test_kept_damaged_and_absent_programs_give_the_same_bits(tmp_path, capsys):
    """A damaged entry is compiled again, and replaced, without a word."""
    folder = tmp_path / "kept"
    new, _ = command(folder, *RUN)
    first = {path: path.read_bytes() for path in entries(folder)}
    assert first and stat.S_IMODE(folder.stat().st_mode) == 0o700
    for path, data in first.items():
        path.write_bytes(data[: len(data) // 2])
    truncated, err = command(folder, *RUN)
    assert "cache" not in err
    assert all(len(path.read_bytes()) > 0.9 * len(data) for path, data in first.items())
    assert main(RUN) == 0  # nothing kept
    assert measures(new) == measures(truncated) == measures(capsys.readouterr().out)


@pytest.fixture
def entry(tmp_path, monkeypatch):
    """A sealed entry in a folder that was prepared: (base, path)."""
    monkeypatch.setattr(kept.atexit, "register", lambda *_: None)
    base = tmp_path / "kept"
    folder, why = kept.prepare(base)
    assert folder is not None and why == ""
    path = folder / f"jit_f-00{kept.ENTRY}"
    path.write_bytes(b"native code")
    kept.seal(folder, 0.0)
    return base, path


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b"native c0de"),
        lambda path: path.write_bytes(b"native"),
        lambda path: path.with_name(path.name + kept.DIGEST).unlink(),
    ],
    ids=["one bit", "truncated", "killed before its digest"],
)
def test_an_entry_that_is_not_as_it_was_written_is_removed(entry, damage):
    base, path = entry
    kept.prepare(base)
    assert path.exists()
    damage(path)
    kept.prepare(base)
    assert not path.exists()


def test_the_oldest_entries_are_removed_where_all_are_too_large(entry, monkeypatch):
    base, old = entry
    os.utime(old, (1.0, 1.0))
    new = old.with_name(f"jit_g-00{kept.ENTRY}")
    new.write_bytes(b"more native code")
    kept.seal(new.parent, 0.0)
    monkeypatch.setattr(kept, "LARGEST", 20)
    kept.prepare(base)
    assert new.exists() and not old.exists()


def other_user(monkeypatch, path):
    """Have the system say that a file or folder belongs to another user."""
    for name in ("stat", "lstat"):
        real = getattr(os, name)

        def status(where, *more, real=real, **options):
            result = real(where, *more, **options)
            same = not isinstance(where, int) and os.fspath(where) == os.fspath(path)
            return os.stat_result((*result[:4], result[4] + 1, *result[5:])) if same else result

        monkeypatch.setattr(kept.os, name, status)


@pytest.mark.parametrize("mode", [0o755, 0o770, 0o777])
def test_a_folder_that_others_can_open_is_refused_and_the_remedy_makes_a_new_one(tmp_path, mode):
    """A program that another user left there must not run after the remedy."""
    base = tmp_path / "open"
    base.mkdir()
    base.chmod(mode)
    folder, why = kept.prepare(base)
    assert folder is None and f"mode {mode:o}" in why and list(base.iterdir()) == []
    assert "remove it" in why and "chmod" not in why


def test_every_level_of_the_folder_must_be_the_users_own(entry, monkeypatch):
    base, path = entry
    for level in (base, path.parent, path, path.with_name(path.name + kept.DIGEST)):
        with monkeypatch.context() as patch:
            other_user(patch, level)
            folder, why = kept.prepare(base)
        assert folder is None and "remove" in why and path.exists()
    path.parent.chmod(0o777)
    folder, why = kept.prepare(base)
    assert folder is None and f"{path.parent.name}' is open to other users" in why
    path.parent.chmod(0o700)
    assert kept.prepare(base) == (path.parent, "")


def test_a_folder_above_that_others_can_write_to_is_refused(tmp_path):
    """Who can rename the folder can put another one there."""
    above = tmp_path / "above"
    above.mkdir()
    above.chmod(0o777)
    folder, why = kept.prepare(above / "kept")
    assert folder is None and f"other users can write to {str(above)!r}" in why
    above.chmod(0o1777)  # as a folder of temporary files is
    assert kept.prepare(above / "kept")[1] == ""


def test_a_link_among_the_entries_is_refused(entry, tmp_path):
    base, path = entry
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    folder, why = kept.prepare(base)
    assert folder is None and "is no file of yours" in why


def test_an_entry_that_others_can_write_to_is_removed(entry):
    base, path = entry
    path.chmod(0o666)
    assert kept.prepare(base)[1] == "" and not path.exists()


@pytest.mark.parametrize("ending", kept.LAZY)
def test_an_entry_of_this_package_is_compared_with_its_digest_when_it_is_read(entry, ending):
    base, other = entry
    path = other.with_name(f"f-00{ending}")
    kept.write(path, b"native code")
    assert kept.prepare(base)[1] == "" and kept.read(path) == b"native code"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    path.write_bytes(b"native c0de")
    with pytest.raises(OSError):
        kept.read(path)
    assert not path.exists()


def test_an_entry_under_another_name_is_removed(entry):
    """Two programs of equal shapes, exchanged with their digests, give each other's numbers."""
    base, path = entry
    other = path.with_name(f"jit_g-00{kept.ENTRY}")
    for suffix in ("", kept.DIGEST):
        path.with_name(path.name + suffix).rename(other.with_name(other.name + suffix))
    kept.prepare(base)
    assert not other.exists()


@pytest.mark.slow
def test_exchanged_programs_do_not_give_the_numbers_of_each_other(tmp_path):
    """Through the command: with digests made anew, by the name inside of each entry."""
    folder, wanted = tmp_path / "kept", {}
    for overflow in ("true", "false"):
        words = [*RUN, "--set", f"plant.overflow={overflow}"]
        wanted[overflow] = measures(command(folder, *words)[0])
    assert wanted["true"] != wanted["false"]
    names = [p for p in entries(folder) if p.name.startswith("evaluate_compiled")]
    first, second = names
    data = first.read_bytes(), second.read_bytes()
    first.write_bytes(data[1])
    second.write_bytes(data[0])
    kept.seal(first.parent, 0.0)
    for overflow, numbers in wanted.items():
        words = [*RUN, "--set", f"plant.overflow={overflow}"]
        assert measures(command(folder, *words)[0]) == numbers


def test_root_makes_no_folder_in_the_home_of_another(tmp_path, monkeypatch):
    home = tmp_path / "home"
    home.mkdir()
    real = kept.Path.stat

    def of_alice(path, **options):
        result = real(path, **options)
        return os.stat_result((*result[:4], 1234, *result[5:])) if path == home else result

    monkeypatch.setattr(kept.Path, "stat", of_alice)
    monkeypatch.setattr(kept.os, "geteuid", lambda: 0)
    assert kept.prepare(home / ".cache" / "jaxtank") == (None, "")
    assert list(home.iterdir()) == []


def test_without_a_home_or_with_one_that_is_a_file_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.delenv(kept.SWITCH, raising=False)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert kept.prepare() == (None, "")
    monkeypatch.setattr(kept.Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert kept.prepare() == (None, "")


def test_the_command_prints_and_clears_what_is_kept(entry, monkeypatch, capsys):
    base, path = entry
    other = base / "mine.txt"
    other.write_text("not a program")
    monkeypatch.setenv(kept.SWITCH, str(base))
    assert main(["cache", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["folder"], result["programs"], result["bytes"]) == (str(base), 1, 11)
    assert main(["cache", "clear"]) == 0 and "1 programs removed" in capsys.readouterr().out
    assert not path.exists() and other.exists()
    assert main(["cache", "clera"]) == 2 and "nearest: clear" in capsys.readouterr().err
    monkeypatch.setenv(kept.SWITCH, "0")
    assert main(["cache"]) == 0 and capsys.readouterr().out == "off: JAXTANK_CACHE=0\n"


@pytest.mark.extended
def test_in_python_programs_are_kept_where_asked(tmp_path):
    program = (
        "import sys, jaxtank, jax\nfound = jaxtank.cache(sys.argv[1])\n"
        "jax.jit(lambda a: a * 2.0)(3.0).block_until_ready()\n"
        "print(len(list(found.glob('*-cache'))))"
    )
    env = {n: v for n, v in os.environ.items() if not n.startswith("JAX_")}
    assert python(program, tmp_path / "kept", env=env) == "1"
