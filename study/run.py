"""The stepping loop of a study: one sample per time step, progress, frames and checkpoints, an end by Ctrl-C that loses nothing."""

import json
import math
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

from quicksand.grains import Frames

from .checkpoint import read_checkpoint, write_checkpoint

REPORTED = ("time", "sub_steps", "sweeps", "residual", "max_overlap", "unconverged", "work_walls", "energy_balance_error")


class Run:
    """Steps a simulation to its end and records one sample per time step.

    Iterating makes the steps and yields their reports; `record` adds to the sample of the step just made:

        run = Run(sim, dt, t_end)
        for report in run:
            run.record(h=top.position[1] - bottom.position[1])
        run["time"], run["h"]

    Ctrl-C ends the loop after the step in progress, a second one at once. A progress bar with the remaining time is
    shown when stderr is a terminal.

    Parameters
    ----------
    sim : quicksand.grains.Simulation
    dt, t_end : float
        Time step and end [s]; the number of steps is t_end / dt, rounded.
    stepper : quicksand.coupling.Coupling, optional
        What makes the steps, where it is not `sim` by itself.

    Raises
    ------
    ValueError
        When dt <= 0, t_end < dt, or either is not finite.
    """

    def __init__(self, sim, dt, t_end, stepper=None):
        if not (0 < dt <= t_end < math.inf):
            raise ValueError(f"Run: dt must be > 0 s and t_end at least dt, got dt = {dt:g} s and t_end = {t_end:g} s")
        self.sim, self.dt, self.stepper = sim, dt, stepper or sim
        self.steps = round(t_end / dt)
        self.samples = 0  # steps made so far
        self.wall_time = 0.0  # spent in stepping [s]
        self.interrupted = False
        self._series = {}  # name: array that doubles when full; NaN where nothing was recorded
        self._files = None

    def __iter__(self):
        in_main_thread = threading.current_thread() is threading.main_thread()  # only there can signals be caught
        before = signal.signal(signal.SIGINT, self._interrupt) if in_main_thread else None
        progress = self._progress_bar()
        try:
            if self._files:
                self._files.before_first_step(self)
            while self.samples < self.steps and not self.interrupted:
                start = time.perf_counter()
                report = self.stepper.step(self.dt)
                self.wall_time += time.perf_counter() - start
                self.samples += 1
                of_grains = getattr(report, "grains", report)
                self.record(**{name: getattr(of_grains, name) for name in REPORTED})
                yield report
                if self._files:
                    self._files.after_step(self)
                if progress is not None:
                    progress.update()
            if self._files:
                self._files.at_end(self)
        finally:
            if progress is not None:
                progress.close()
            if in_main_thread:
                signal.signal(signal.SIGINT, before)

    def keep(self, flags, **parts):
        """Write frames and checkpoints from now on, or go on from the checkpoint of --restart.

        Parameters
        ----------
        flags : argparse.Namespace
            Of `study.Parser`: out, restart, frame_every, checkpoint_every, and all others as the parameters of the run.
        **parts
            What changes during the run beside the simulation: random generators of numpy, and objects with `state()`, an array or a dict
            of arrays, and `restore(state)`. They are restored in this order. Those with `frame()` are in the frames, too.
        """
        self._files = _Files(self, flags, parts)

    def record(self, **values):
        """Put scalars into the sample of the step just made."""
        for name, value in values.items():
            column = self._series.get(name)
            if column is None:
                column = self._series[name] = np.full(1024, np.nan)
            while self.samples > column.size:
                column = self._series[name] = np.concatenate([column, np.full(column.size, np.nan)])
            column[self.samples - 1] = value

    def __getitem__(self, name):
        """Series of a recorded quantity, (samples,) array."""
        return self._series[name][:self.samples] if self.samples else np.empty(0)

    @property
    def names(self):
        """Of the recorded quantities."""
        return list(self._series)

    def since(self, start):
        """The samples with time >= start [s], as a `Window`; none where start is None."""
        chosen = self["time"] >= (np.inf if start is None else start)
        return Window({name: self[name][chosen] for name in self._series})

    def solver_results(self, diameter):
        """What results.json says of every run about the solver; overlap in units of `diameter` [m]."""
        steps, work = self["sub_steps"].sum(), abs(self["work_walls"].sum())
        return {
            "max_overlap": self["max_overlap"].max(initial=0.0) / diameter,
            "energy_error": abs(self["energy_balance_error"].sum()) / work if work > 0 else None,
            "residual_max": self["residual"].max(initial=0.0),
            "unconverged_steps": int(self["unconverged"].sum()),
            "steps": int(steps),
            "sweeps_per_step": self["sweeps"].sum() / steps if steps > 0 else None,
            "wall_time": self.wall_time,
            "threads": self.sim.threads,
        }

    def _interrupt(self, *_):
        self.interrupted = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def _progress_bar(self):
        if not sys.stderr.isatty():
            return None
        from tqdm import tqdm

        return tqdm(total=self.steps, initial=self.samples, unit="step", smoothing=0.05, leave=False, dynamic_ncols=True)


class _Files:
    """Frames every so often in the time of the scene, checkpoints every so often on the clock."""

    def __init__(self, run, flags, parts):
        self.parts, self.path = parts, flags.out / "checkpoint.h5"
        self.parameters = json.dumps({name: str(value) if isinstance(value, Path) else value for name, value in vars(flags).items()})
        self.frame_steps = max(round(flags.frame_every / run.dt), 1) if flags.frame_every > 0 else 0
        self.checkpoint_every = flags.checkpoint_every
        self.shown = [part for part in parts.values() if hasattr(part, "frame")]
        self.written = 0  # samples that are in frames
        count = self._restore(run, flags.restart) if flags.restart else 0
        self.frames = Frames(flags.out, self.parameters, count) if self.frame_steps else None
        self.last = time.monotonic()

    def before_first_step(self, run):
        if self.frames and run.samples == 0:
            self.frames.write(run.sim, *self.shown)

    def after_step(self, run):
        if self.frames and run.samples % self.frame_steps == 0:
            self.frames.write(run.sim, *self.shown, series={name: run[name][self.written:] for name in run.names})
            self.written = run.samples
        if 0 < self.checkpoint_every <= time.monotonic() - self.last:
            self._checkpoint(run)

    def at_end(self, run):
        if self.checkpoint_every > 0:
            self._checkpoint(run)

    def _checkpoint(self, run):
        parts = {"grains": {"state": run.sim.state()}, "series": {name: run[name] for name in run.names},
                 "run": {"samples": run.samples, "wall_time": run.wall_time, "written": self.written,
                         "frames": self.frames.count if self.frames else 0}}
        for name, part in self.parts.items():
            random = isinstance(part, np.random.Generator)
            state = json.dumps(part.bit_generator.state) if random else part.state()
            parts[name] = state if isinstance(state, dict) else {"state": state}
        write_checkpoint(self.path, self.parameters, parts)
        self.last = time.monotonic()

    def _restore(self, run, path):
        _, parts = read_checkpoint(path)
        run.sim.restore(parts["grains"]["state"])
        for name, part in self.parts.items():
            state = parts.get(name, {})
            if isinstance(part, np.random.Generator):
                part.bit_generator.state = json.loads(bytes(state["state"]))
            else:
                part.restore(state["state"] if state.keys() == {"state"} else state)
        run.samples, run.wall_time = int(parts["run"]["samples"]), float(parts["run"]["wall_time"])
        run._series = dict(parts.get("series", {}))
        self.written = int(parts["run"]["written"])
        return int(parts["run"]["frames"])


class Window(dict):
    """Series over a part of a run, by name; empty where nothing was recorded."""

    def __missing__(self, name):
        return np.empty(0)

    def mean(self, name):
        """Mean of the samples that are not NaN, or None without any."""
        return self._of_finite(name, np.mean)

    def std(self, name):
        """Standard deviation of the samples that are not NaN, or None without any."""
        return self._of_finite(name, np.std)

    def _of_finite(self, name, function):
        values = self[name][np.isfinite(self[name])]
        return float(function(values)) if values.size else None
