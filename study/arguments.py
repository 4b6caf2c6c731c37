"""Flags of a study's command line. A wrong one ends the program with one line on stderr and exit status 2."""

import argparse
import contextlib
import math
import os
import sys
import tempfile
from pathlib import Path

from .checkpoint import read_checkpoint


FREE = {"out", "threads", "t_end", "no_plots", "frame_every", "checkpoint_every", "restart"}  # may change when a run goes on


class CommandLine(argparse.ArgumentParser):
    """A command line whose errors are one line on stderr and exit status 2, and whose --help is the script's docstring."""

    def __init__(self, doc):
        super().__init__(allow_abbrev=False)
        self.doc = doc

    @contextlib.contextmanager
    def user_errors(self, *kinds):
        """Around what a wrong flag or a full disk can break: such errors end the program (all of `kinds`; by default those of a scene)."""
        try:
            yield
        except kinds or (ValueError, OSError, MemoryError) as error:
            self.error(str(error))

    def format_help(self):
        return self.doc.strip() + "\n"

    def error(self, message):
        sys.stdout.flush()
        self.exit(2, f"{self.prog}: {' '.join(message.split())}{os.linesep}")


class Parser(CommandLine):
    """Command line of a study, with the flags that every study has.

    --out, --threads, --seed, --quick, --no-plots, --dt, --t-end, --tolerance, and of its files --frame-every, --checkpoint-every,
    --restart. `--help` prints the study's docstring.

    Parameters
    ----------
    doc : str
        The docstring of the study; it explains each flag.
    out : str
        Default output directory.
    dt, t_end : float
        Defaults [s].
    quick_t_end : float
        Default of --t-end with --quick [s].
    """

    def __init__(self, doc, out, dt, t_end, quick_t_end):
        super().__init__(doc)
        self.quick = {}  # values that --quick puts in place of defaults
        self.flag("--out", type=Path, default=Path(out))
        self.flag("--threads", type=whole(at_least=1))
        self.flag("--seed", type=whole(at_least=0), default=0)
        self.flag("--quick", action="store_true")
        self.flag("--no-plots", action="store_true")
        self.flag("--dt", type=number("s", above=0), default=dt)
        self.flag("--t-end", type=number("s", above=0), default=t_end, quick=quick_t_end)
        self.flag("--tolerance", type=number("", above=0))
        self.flag("--frame-every", type=number("s", at_least=0), default=0.1)
        self.flag("--checkpoint-every", type=number("s", at_least=0), default=60.0)
        self.flag("--restart", type=Path)

    def flag(self, name, *, quick=None, **options):
        """`add_argument`, and the value that --quick uses where the user gives none."""
        action = self.add_argument(name, **options)
        if quick is not None:
            self.quick[action.dest] = quick

    def defaults(self):
        """The flags of an empty command line, by name; no directory is made."""
        return vars(super().parse_args([]))

    def parse_args(self, args=None, namespace=None):
        """Parse and check the flags, and make the output directory."""
        flags = super().parse_args(args, namespace)
        if flags.restart:
            flags = self._as_before(flags.restart, args)
        elif flags.quick:
            self.set_defaults(**self.quick)
            flags = super().parse_args(args, namespace)
        if flags.t_end < flags.dt:
            self.error(f"argument --t-end: must be at least one time step (--dt {flags.dt:g} s), got {flags.t_end:g} s")
        if flags.t_end > 1e9 * flags.dt:
            self.error(f"argument --t-end: must be at most 1e9 time steps (--dt {flags.dt:g} s), got {flags.t_end:g} s")
        with self.user_errors():
            flags.out.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=flags.out):
                pass  # better now than after the run
        return flags

    def _as_before(self, path, args):
        """The flags of the run that left the checkpoint; given anew only where that does not change what has been computed."""
        with self.user_errors():
            before, _ = read_checkpoint(path)
        defaults, absent = self.defaults(), object()
        self.set_defaults(**dict.fromkeys(defaults, absent))
        given = {name: value for name, value in vars(super().parse_args(args)).items() if value is not absent}
        self.set_defaults(**defaults)
        for name, value in given.items():
            if name in defaults.keys() - FREE and value != before.get(name, value):
                self.error(f"argument --{name.replace('_', '-')}: is {before[name]} in {path}, cannot be {value} after a restart")
        kept = {name: value for name, value in before.items() if name in defaults and name not in ("restart", "out")}
        return argparse.Namespace(**(defaults | kept | {"out": path.parent} | given))


def number(unit, above=None, at_least=None):
    """Argument type: a finite number with a lower bound, in `unit`."""

    def convert(text):
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise argparse.ArgumentTypeError(f"must be a number{f' [{unit}]' if unit else ''}, got {text!r}")
        if (above is not None and value <= above) or (at_least is not None and value < at_least):
            rule = f"> {above:g}" if above is not None else f">= {at_least:g}"
            raise argparse.ArgumentTypeError(f"must be {rule} {unit}".rstrip() + f", got {text}")
        return value

    return convert


def whole(at_least):
    """Argument type: a whole number with a lower bound."""

    def convert(text):
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"must be a whole number, got {text!r}") from None
        if value < at_least:
            raise argparse.ArgumentTypeError(f"must be >= {at_least}, got {value}")
        return value

    return convert
