"""Ensembles whose draws do not fit in memory: the same numbers, and few bytes a draw."""

import pickle
import tracemalloc

import numpy as np
import pytest
from scipy import stats

import tuning
from jaxtank import presets, rig
from jaxtank.core.errors import InputError
from tuning.storage import columns
from tuning.storage.columns import Columns, column
from tuning.uncertainty.sampling import Points
from tuning.uncertainty.study import QUANTITIES, Ensemble

MEASURES = ("rms_error", "max_level")
SPREAD = {"plant.drain": 0.05, "plant.pump_gain": tuning.Normal(relative=0.05)}


@pytest.fixture(scope="module")
def case():
    """Two samples: what is held per draw does not depend on the length of a run."""
    short = {"clock.dt": 4.0, "clock.duration": 8.0, "sensor.noise": 0.02}
    return rig.set_values(presets.find("cascaded/pi"), short)


def streamed(monkeypatch):
    """From here on every array is in a file."""
    monkeypatch.setattr(columns, "IN_MEMORY", 0)


def expected(values):
    """Statistics of (draws, ...) values at once, of a measure of which a larger one is worse."""
    half = 1.959964 * values.std(axis=0, ddof=1) / np.sqrt(len(values))
    mean = values.mean(axis=0)
    low = np.maximum(mean - half, np.minimum(0.0, values.min(axis=0)))
    worst = np.sort(values, axis=0)[-int(np.ceil(0.05 * len(values))) :]
    p05, p50, p95 = np.quantile(values, (0.05, 0.5, 0.95), axis=0, method="inverted_cdf")
    sd = values.std(axis=0, ddof=1)
    return dict(
        zip(QUANTITIES, (mean, [low, mean + half], sd, p05, p50, p95, worst.mean(0), values.max(0)))
    )


@pytest.mark.extended
def test_arrays_in_a_file_give_the_bits_of_those_in_memory(case, monkeypatch):
    options = {"samples": 300, "key": 3, "batch": 64, "limits": {"max_level": 3.0}}
    options["measures"] = MEASURES
    held = tuning.ensemble(case, SPREAD, **options)
    streamed(monkeypatch)
    monkeypatch.setattr(columns, "ROWS", 50)
    found = tuning.ensemble(case, SPREAD, **options)
    assert isinstance(found.measures["max_level"], np.memmap)
    assert isinstance(held.measures["max_level"], np.ndarray)
    for mine, theirs in ((found.measures, held.measures), (found.values, held.values)):
        assert list(mine) == list(theirs)
        for name in mine:
            np.testing.assert_array_equal(mine[name], theirs[name])
    assert repr(found.summary()) == repr(held.summary())
    assert found.violations() == held.violations() and found.violations()[0]["count"] > 0
    assert repr(found.fan) == repr(held.fan)
    again = pickle.loads(pickle.dumps(found.measures))
    assert type(again) is dict and np.array_equal(again["max_level"], held.measures["max_level"])


@pytest.mark.parametrize("entries", [(), (1,), (2,), (5,)])
def test_statistics_are_those_of_the_whole_array_to_the_bit(entries, monkeypatch):
    monkeypatch.setattr(columns, "ROWS", 1000)
    rng = np.random.default_rng(0)
    values = rng.lognormal(0.0, 2.0, (20_001, *entries))
    failed = rng.random(len(values)) < 0.1
    name = "rms_error" if entries else "rms_error_total"
    found = Ensemble(
        case=None, distributions={}, labels=[], values={}, measures={name: values}, failed=failed,
        infeasible=None, limits=[], fan=None, wall_s=0.0, seed=0, method="random",
    ).summary()[name]  # fmt: skip
    for quantity, value in expected(values[~failed]).items():
        np.testing.assert_array_equal(found[quantity], value, err_msg=quantity)


@pytest.mark.parametrize("method", ["random", "latin", "sobol"])
@pytest.mark.filterwarnings("error")
def test_points_some_at_a_time_are_those_drawn_at_once(method):
    if method == "random":
        whole = np.random.default_rng(7).random((1000, 3))
    elif method == "latin":
        whole = stats.qmc.LatinHypercube(3, rng=np.random.default_rng(7)).random(1000)
    else:
        whole = stats.qmc.Sobol(3, rng=np.random.default_rng(7)).random_base2(10)[:1000]
    points = Points(method, 3, 1000, 7)
    for size in (50, 256):
        parts = [points.rows(i, min(i + size, 1000)) for i in range(0, 1000, size)]
        np.testing.assert_array_equal(np.concatenate(parts), whole)
    np.testing.assert_array_equal(points.rows(990, 1000), whole[990:])
    np.testing.assert_array_equal(points.rows(3, 5), whole[3:5])


@pytest.mark.slow
def test_a_draw_takes_a_few_bytes_of_memory(case, monkeypatch):
    """Its measures and values take 136 bytes, of which one column, two flags remain."""
    streamed(monkeypatch)
    draw = lambda samples: tuning.ensemble(case, SPREAD, samples=samples, batch=2048, fan=False)
    draw(2048)  # what is compiled is not counted
    peaks = []
    for samples in (18_000, 36_000):  # more than the block of `needs`
        tracemalloc.start()
        found = draw(samples)
        found.summary(), found.violations()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    a_draw = sum(v[:1].nbytes for t in (found.measures, found.values) for v in t.values())
    assert a_draw > 100
    assert (peaks[1] - peaks[0]) / 18_000 < 25


def test_a_full_disk_is_an_error_in_one_line(monkeypatch, tmp_path):
    def full(*_):
        raise OSError(28, "No space left on device")

    streamed(monkeypatch)
    monkeypatch.setattr(columns.os, "posix_fallocate", full, raising=False)
    with pytest.raises(InputError, match=r"cannot hold 1000 draws \(No space left"):
        Columns(1000, tmp_path).put(0, {"a": np.zeros((1, 2))})
    assert not any(tmp_path.iterdir())


def test_rows_beyond_the_last_are_dropped_and_a_column_is_read_in_blocks(monkeypatch):
    streamed(monkeypatch)
    monkeypatch.setattr(columns, "ROWS", 3)
    table = Columns(10)
    block = np.arange(48.0).reshape(12, 2, 2)
    for start in (8, 0, 4):
        table.put(start, {"a": block[start : start + 4]})
    kept = np.arange(10) % 3 > 0
    np.testing.assert_array_equal(table["a"], block[:10])
    np.testing.assert_array_equal(column(table, "a", 2, kept), block[:10][kept][:, 1, 0])
