"""What every study repeats: flags, the stepping loop, results.json, the summary."""

import json
import math
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import quicksand
from quicksand import study

PACKAGE = Path(quicksand.__file__).parents[1]


class Clock:
    """A simulation in which only time passes."""

    threads = 1

    def __init__(self, interrupt_at=None):
        self.time, self.made, self.interrupt_at = 0.0, 0, interrupt_at

    def step(self, dt):
        self.time += dt
        self.made += 1
        if self.made == self.interrupt_at:
            os.kill(os.getpid(), signal.SIGINT)
        return SimpleNamespace(time=self.time, sub_steps=2, sweeps=10, residual=1e-4 * self.made, max_overlap=1e-6, unconverged=0,
                               work_walls=2.0, energy_balance_error=1e-3)


def parse(tmp_path, *args):
    parser = study.Parser("doc", out=tmp_path / "out", dt=1e-3, t_end=10.0, quick_t_end=1.0)
    parser.flag("--height", type=study.number("m", above=0), default=0.1, quick=0.03)
    return parser.parse_args(list(args))


def test_quick_replaces_defaults_but_not_what_is_given(tmp_path):
    flags = parse(tmp_path, "--quick", "--t-end", "5")
    assert flags.height == 0.03 and flags.t_end == 5.0
    assert parse(tmp_path).height == 0.1
    assert (tmp_path / "out").is_dir()


@pytest.mark.parametrize("args, rule", [
    (["--height", "-1"], "must be > 0 m, got -1"), (["--height", "nan"], "must be a number"), (["--height", "inf"], "must be a number"),
    (["--threads", "0"], "must be >= 1, got 0"), (["--seed", "1.5"], "must be a whole number"), (["--dt", "0"], "must be > 0 s"),
    (["--t-end", "1e-4"], "at least one time step"), (["--heigh", "1"], "unrecognized"), (["--out", "/proc/nowhere/x"], "No such file"),
])
def test_a_wrong_flag_ends_with_one_line_and_status_2(tmp_path, capsys, args, rule):
    with pytest.raises(SystemExit) as end:
        parse(tmp_path, *args)
    message = capsys.readouterr().err
    assert end.value.code == 2 and rule in message and message.count("\n") == 1


def test_a_run_records_one_sample_per_step():
    run = study.Run(Clock(), dt=0.1, t_end=1.0)
    for report in run:
        run.record(height=report.time**2)
    np.testing.assert_allclose(run["time"], 0.1 * np.arange(1, 11), rtol=1e-12)
    np.testing.assert_array_equal(run["height"], run["time"] ** 2)
    late = run.since(0.65)
    assert late["time"].size == 4 and late.mean("height") == pytest.approx((0.7**2 + 0.8**2 + 0.9**2 + 1.0) / 4)
    assert run.since(None).mean("height") is None and run.since(0.0).mean("never recorded") is None
    assert run.solver_results(1e-3) == pytest.approx({
        "max_overlap": 1e-3, "energy_error": 1e-2 / 20.0, "residual_max": 1e-3, "unconverged_steps": 0, "steps": 20,
        "sweeps_per_step": 5.0, "wall_time": run.wall_time, "threads": 1})


def test_a_series_grows_with_the_run_and_is_nan_where_nothing_was_recorded():
    run = study.Run(Clock(), dt=0.1, t_end=500.0)
    for _ in run:
        if run.samples > 3000:
            run.record(late=run.samples)
    assert run["late"].size == run["time"].size == 5000
    assert np.isnan(run["late"][:3000]).all() and (run["late"][3000:] == np.arange(3001, 5001)).all()


def test_means_leave_out_samples_that_are_not_defined():
    run = study.Run(Clock(), dt=0.1, t_end=0.3)
    for report in run:
        run.record(length=math.nan if run.samples == 2 else 1.0 * run.samples)
    assert run.since(0.0).mean("length") == 2.0 and run.since(0.0).std("length") == 1.0


def test_ctrl_c_ends_the_loop_after_the_step_and_keeps_the_samples():
    handler = signal.getsignal(signal.SIGINT)
    run = study.Run(Clock(interrupt_at=4), dt=0.1, t_end=1.0)
    for _ in run:
        pass
    assert run.interrupted and run.samples == 4 and run["time"].size == 4
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_run_ended_before_its_first_sample_still_has_results():
    run = study.Run(Clock(), dt=0.1, t_end=1.0)
    assert run["time"].size == 0 and run.since(0.0).mean("height") is None
    assert run.solver_results(1e-3)["energy_error"] is None


@pytest.mark.parametrize("terminal", [True, False])
def test_the_progress_bar_is_shown_on_a_terminal_only(terminal):
    script = ("from types import SimpleNamespace; from quicksand import study\n"
              "report = SimpleNamespace(**dict.fromkeys(study.run.REPORTED, 0))\n"
              "for _ in study.Run(SimpleNamespace(step=lambda dt: report), 1.0, 20.0): pass\n")
    reader, writer = pty.openpty() if terminal else os.pipe()
    subprocess.run([sys.executable, "-c", script], stderr=writer, check=True, env=os.environ | {"PYTHONPATH": str(PACKAGE)})
    os.close(writer)
    shown = b""
    try:
        while chunk := os.read(reader, 4096):
            shown += chunk
    except OSError:  # how a terminal whose other end is closed says that there is no more
        pass
    os.close(reader)
    assert (b"/20" in shown) if terminal else shown == b""


def test_results_are_plain_json_with_null_for_what_is_undefined(tmp_path):
    path = tmp_path / "results.json"
    study.write_results(path, {"a": np.float64(1.5), "b": float("nan"), "c": None, "d": np.int64(3), "e": "flowing",
                               "f": np.array([1.0, np.inf])})
    assert json.loads(path.read_text()) == {"a": 1.5, "b": None, "c": None, "d": 3, "e": "flowing", "f": [1.0, None]}
    assert [file.name for file in tmp_path.iterdir()] == ["results.json"]


def test_a_failed_write_leaves_the_old_results(tmp_path):
    path = tmp_path / "results.json"
    study.write_results(path, {"a": 1})
    with pytest.raises(TypeError):
        study.write_results(path, {"a": object()})
    assert json.loads(path.read_text()) == {"a": 1}
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError):
        study.write_results(tmp_path / "folder", {"a": 1})
    assert sorted(file.name for file in tmp_path.iterdir()) == ["folder", "results.json"]  # no temporary file stays


def test_the_summary_shows_error_deviation_and_reference(capsys):
    results = {"phi": 0.76712, "phi_err": 0.00012, "phi_std": 0.003, "mu": None, "steps": 123456}
    study.print_summary("title", results, {"phi": "-", "mu": "-", "steps": ""}, {"phi": "0.767"})
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[2] == ["phi", "-", "0.7671", "+-", "0.00012", "(0.003)", "0.767"]
    assert lines[3] == ["mu", "-", "-"] and lines[4] == ["steps", "123456"]
