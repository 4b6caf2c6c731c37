"""The stepping loop of a study: one sample per time step, progress, an end by Ctrl-C that loses nothing."""

import signal
import sys
import threading
import time

import numpy as np

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
    """

    def __init__(self, sim, dt, t_end):
        self.sim, self.dt = sim, dt
        self.steps = round(t_end / dt)
        self.samples = 0  # steps made so far
        self.wall_time = 0.0  # spent in stepping [s]
        self.interrupted = False
        self._series = {}  # name: array that doubles when full; NaN where nothing was recorded

    def __iter__(self):
        in_main_thread = threading.current_thread() is threading.main_thread()  # only there can signals be caught
        before = signal.signal(signal.SIGINT, self._interrupt) if in_main_thread else None
        progress = self._progress_bar()
        try:
            while self.samples < self.steps and not self.interrupted:
                start = time.perf_counter()
                report = self.sim.step(self.dt)
                self.wall_time += time.perf_counter() - start
                self.samples += 1
                self.record(**{name: getattr(report, name) for name in REPORTED})
                yield report
                if progress is not None:
                    progress.update()
        finally:
            if progress is not None:
                progress.close()
            if in_main_thread:
                signal.signal(signal.SIGINT, before)

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

        return tqdm(total=self.steps, unit="step", smoothing=0.05, leave=False, dynamic_ncols=True)


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
