"""Logs that read well and cannot be fitted: one line, exit code 5, by the command and in Python."""

import numpy as np
import pytest

import tuning
from jaxtank import presets
from jaxtank.core.errors import DataError
from tuning.cli import main

HEADER = "t [s],pump1 [V],pump2 [V],h1 [cm],h2 [cm],h3 [cm],h4 [cm]"
FREE = {"plant.pump_gain": (0.5, 10.0)}


@pytest.fixture(scope="module")
def case():
    return presets.load("mirakhorli").cases["sfc"]


def made(count):
    """(t, u, y) of `count` samples of a rise."""
    t = np.arange(float(count))
    rise = 1 - np.exp(-t / 20)[:, None]
    return (
        t,
        np.tile([3.0, 2.8], (count, 1)),
        np.array([2.0, 2.0, 1.0, 1.0]) + rise * np.array([5.0, 6.0, 2.0, 3.0]),
    )


def text(t, u, y, header=HEADER):
    return (
        "\n".join(
            [header, *(",".join(f"{v:.10g}" for v in row) for row in np.column_stack([t, u, y]))]
        )
        + "\n"
    )


def late(count=30):
    """A record whose last sample is a thousand million seconds late."""
    t, u, y = made(count + 1)
    t[-1] = 1e9
    return t, u, y


@pytest.fixture
def refused(tmp_path, capsys, monkeypatch):
    """refused(text of l.csv or None, file, options) -> the one line on stderr."""

    def run(content, name="l.csv", *options):
        monkeypatch.chdir(tmp_path)
        if content is not None:
            (tmp_path / name).write_text(content)
        code = main.main(
            [
                "identify",
                "mirakhorli/sfc",
                "--data",
                name,
                "--free",
                "plant.pump_gain=0.5:10",
                "--starts",
                "1",
                *options,
            ]
        )
        printed = capsys.readouterr()
        (line,) = printed.err.splitlines()
        assert code == 5 and printed.out == ""
        return line

    return run


def test_two_samples_are_too_few(refused):
    assert "l.csv: number of samples is 2" in refused(text(*made(2)))


def test_two_samples_are_too_few_beside_others(case):
    logs = [tuning.log(t=t, u=u, y=y) for t, u, y in (made(20), made(2))]
    with pytest.raises(DataError, match="number of samples is 2"):
        tuning.identify_many(case, logs, FREE, start="case", noise=0.1)


def test_a_step_too_long_to_be_simulated(refused, case):
    """Held back or not, and where the readings after it would have been the answer's undoing."""
    words = "line 32, column 't [s]': 1e+09 s after the sample before: too long"
    assert words in refused(text(*late()), "l.csv", "--gap", "1e12")
    t, u, y = late()
    with pytest.raises(DataError, match=r"sample 31: 1e\+09 s after the sample before: too long"):
        tuning.identify(case, tuning.log(t=t, u=u, y=y), FREE, starts=1, gap=1e12, hold_back=0)


@pytest.mark.slow
def test_a_step_that_is_long_and_can_be_simulated_is_taken(case):
    """Three minutes without a sample, among the samples held back: as many steps as it needs are
    taken over it.
    """
    t, u, y = made(40)
    t[-1] += 180.0
    found = tuning.identify(
        case, tuning.log(t=t, u=u, y=y), {"plant.pump_gain": (5.0, 60.0)}, starts=1, gap=1e3
    )
    assert np.all(np.isfinite(found.quality["rmse"])) and found.estimation.substeps > 2


def test_a_header_of_thousands_of_digits_is_no_tank(refused):
    header = HEADER.replace(
        "h1 [cm],h2 [cm],h3 [cm],h4",
        ",".join(f"h{'9' * 4500}{i} [cm]" for i in range(3)) + ",h" + "9" * 4500,
    )
    assert "no column for a level among" in refused(text(*made(30), header))


def test_a_file_whose_name_is_too_long_is_a_log_that_is_not_there(refused):
    assert "cannot be read: File name too long" in refused(None, "a" * 5000)


def test_data_that_are_refused_after_reading_get_one_line(refused):
    """Two checks of what was read: a gap, and fewer readings than unknowns."""
    t, u, y = made(30)
    assert "a gap of 31 s" in refused(text(np.where(t > 20, t + 30, t), u, y))
    sparse = np.where(np.arange(30)[:, None] == np.array([0, 1, 2, 3]), y, np.nan)
    assert "readings cannot determine" in refused(text(t, u, sparse), "l.csv", "--hold-back", "0")
