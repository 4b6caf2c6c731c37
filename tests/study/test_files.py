"""What a run leaves on disk: frames, XDMF, checkpoints; a run that is killed, and one that goes on."""

import json
import os
import random
import subprocess
import sys
import textwrap
import xml.etree.ElementTree as xml
from pathlib import Path

import h5py
import numpy as np
import pytest

import quicksand
from quicksand import grains
from quicksand.study.checkpoint import read_checkpoint, write_checkpoint

EXAMPLE = Path(__file__).parents[2] / "examples" / "dry_couette.py"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(quicksand.__file__).parents[1])}
CELL = ("--height", "0.02", "--width", "0.04", "--t-end", "1", "--no-plots", "--threads", "1", "--frame-every", "0.05")


def command(*args):
    return [sys.executable, EXAMPLE, *map(str, args)]


def run(*args, **options):
    return subprocess.run(command(*args), env=ENVIRONMENT, capture_output=True, text=True, **options)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """Folder of a run without a break."""
    out = tmp_path_factory.mktemp("unbroken")
    assert run("--out", out, *CELL).stderr == ""
    return out


def results(out):
    found = json.loads((out / "results.json").read_text())
    del found["wall_time"], found["threads"]
    return found


def frames(out):
    """Every array of every frame, by frame and path."""
    arrays = {}
    with h5py.File(out / "run.h5") as index:
        for number, frame in index["frames"].items():
            for name in ("grains", "contacts"):
                arrays.update({f"{number}/{name}/{item}": data[()] for item, data in frame[name].items()})
            if "series" in frame:
                arrays.update({f"{number}/series/{field}": frame["series"][field] for field in frame["series"].dtype.names})
    return arrays


def assert_same(one, other):
    assert results(one) == results(other)
    ours, theirs = frames(one), frames(other)
    assert sorted(ours) == sorted(theirs)
    for name in ours:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)


def assert_readable(out):
    """All that is in the index, and all that the XDMF files point to; returns the number of frames."""
    if not (out / "run.h5").exists():
        return 0
    found = frames(out)
    if not found:  # killed before the first
        return 0
    for name in ("grains", "contacts"):
        for item in xml.parse(out / f"{name}.xdmf").iter("DataItem"):
            path, place = item.text.split(":")
            with h5py.File(out / path) as file:
                data = file[place]
                assert data.shape == tuple(map(int, item.get("Dimensions").split())), place
                assert (item.get("NumberType"), int(item.get("Precision"))) == ({"f": "Float", "i": "Int"}[data.dtype.kind], data.dtype.itemsize)
    return len({name.split("/")[0] for name in found})


def test_frames_hold_the_scene_and_the_series(unbroken):
    with h5py.File(unbroken / "run.h5") as index:
        assert index.attrs["version"] == grains.__version__
        parameters = json.loads(index.attrs["parameters"])
        assert (parameters["rate"], parameters["seed"], parameters["height"]) == (10.0, 0, 0.02)
        shots = list(index["frames"].values())
        assert [shot.attrs["time"] for shot in shots] == pytest.approx(0.05 * np.arange(21))
        n = results(unbroken)["n_grains"]
        last = shots[-1]
        assert {name: last["grains"][name].shape for name in last["grains"]} == {
            "position": (n, 3), "radius": (n,), "velocity": (n, 3), "spin": (n,)}
        mu = np.concatenate([shot["series"]["mu"] for shot in shots if "series" in shot])
        assert mu.size == 1000
        force = last["contacts/force"][()]
        np.testing.assert_allclose(np.abs(force[:, 2]), 0)
        # Between two grains: the line joins their centres, up to a period.
        between = (last["contacts/grain_i"][()] >= 0) & (last["contacts/grain_j"][()] >= 0)
        line = last["contacts/position"][()].reshape(-1, 2, 3)[between]
        np.testing.assert_allclose(np.linalg.norm(line[:, 1] - line[:, 0], axis=1), 2e-3, rtol=2e-2)
        normal = (line[:, 1] - line[:, 0]) / np.linalg.norm(line[:, 1] - line[:, 0], axis=1)[:, None]
        along = last["contacts/force_normal"][()][between]  # normals are those before the grains were moved
        np.testing.assert_allclose((force[between] * normal).sum(axis=1), along, atol=0.02 * along.max())
    assert assert_readable(unbroken) == 21


def test_a_run_killed_at_any_moment_can_be_read_and_goes_on_bit_for_bit(unbroken, tmp_path):
    chance, kills, out = random.Random(1), 0, tmp_path / "first"
    start = ["--out", out, *CELL, "--checkpoint-every", "0.01"]
    args, finished = start, 0
    while kills < 8 or not finished:
        process = subprocess.Popen(command(*args), env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        try:
            assert process.wait(chance.uniform(0.3, 1.5)) == 0, process.stderr.read()
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
            assert_readable(out)
            args = ["--restart", out / "checkpoint.h5"] if (out / "checkpoint.h5").exists() else start
            continue
        finally:
            process.stderr.close()
        assert_same(unbroken, out)
        finished += 1
        out = tmp_path / f"after_{kills}_kills"
        args = start = ["--out", out, *CELL, "--checkpoint-every", "0.01"]


def test_a_finished_run_can_be_made_longer(unbroken, tmp_path):
    assert run("--out", tmp_path / "short", *CELL, "--t-end", "0.4").stderr == ""
    longer = run("--restart", tmp_path / "short" / "checkpoint.h5", "--t-end", "1", "--threads", "2")
    assert longer.stderr == ""
    # The end does not change the steps; --fixed-height would.
    assert_same(unbroken, tmp_path / "short")


def test_random_numbers_and_forces_drawn_during_a_run_go_on(tmp_path):
    script = textwrap.dedent("""
        import sys
        import numpy as np
        from quicksand import grains, study
        parser = study.Parser("doc", out="out", dt=1e-3, t_end=0.2, quick_t_end=0.1)
        flags = parser.parse_args()
        rng = np.random.default_rng(flags.seed)
        sim = grains.Simulation(dim=3, threads=1)
        sim.set_friction("grain", "grain", 0.3)
        sim.set_friction("grain", "wall", 0.3)
        sim.set_restitution("grain", "grain", 0.8, 0.1)
        x, y, z = np.meshgrid(*[np.arange(4) * 2.2e-3] * 3)
        sim.add(np.column_stack([x.ravel(), y.ravel() + 1.2e-3, z.ravel()]), 1e-3)
        sim.add_plane((0, 0, 0), (0, 1, 0))
        sim.gravity = (0, -9.81, 0)
        run = study.Run(sim, flags.dt, flags.t_end)
        run.keep(flags, rng=rng)
        for report in run:
            sim.set_force(1e-5 * rng.standard_normal((sim.count, 3)))
        study.write_results(flags.out / "results.json", {"x": sim.position.ravel(), "draw": rng.random()})
    """)
    (tmp_path / "script.py").write_text(script)

    def go(*args):
        done = subprocess.run([sys.executable, tmp_path / "script.py", *args], env=ENVIRONMENT, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    go("--out", "whole")
    go("--out", "parts", "--t-end", "0.07")
    go("--restart", "parts/checkpoint.h5", "--t-end", "0.2")
    one, other = (json.loads((tmp_path / name / "results.json").read_text()) for name in ("whole", "parts"))
    assert one == other


@pytest.mark.parametrize("args, words", [
    (["--rate", "5"], "--rate: is 10.0 in"), (["--size-ratio", "2"], "--size-ratio: is 1.0 in"), (["--dt", "1e-4"], "--dt: is 0.001 in"),
])
def test_what_was_computed_with_one_flag_does_not_go_on_with_another(unbroken, args, words):
    done = run("--restart", unbroken / "checkpoint.h5", *args)
    assert done.returncode == 2 and words in done.stderr and done.stderr.count("\n") == 1


def test_a_bad_restart_file_is_named_and_nothing_is_lost(unbroken, tmp_path):
    good = (unbroken / "checkpoint.h5").read_bytes()
    bad = tmp_path / "bad.h5"

    def refused(data, words):
        bad.write_bytes(data)
        done = run("--restart", bad, "--out", tmp_path / "out")
        assert done.returncode == 2 and words in done.stderr and done.stderr.count("\n") == 1, done.stderr
        assert not (tmp_path / "out").exists()

    for share in (0.0, 0.1, 0.9, 0.9999):
        refused(good[:int(share * len(good))], "damaged or cut short")
    at = len(good) // 2
    refused(good[:at] + bytes(64) + good[at + 64:], "damaged")
    write_checkpoint(tmp_path / "other.h5", "{}", {})
    with h5py.File(tmp_path / "other.h5", "a") as file:
        file.attrs["version"] = "99.9"
    refused((tmp_path / "other.h5").read_bytes(), "of version 99.9, but this is version")
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["x"] = 1
    refused((tmp_path / "foreign.h5").read_bytes(), "is no checkpoint")
    done = run("--restart", tmp_path / "nowhere.h5")
    assert done.returncode == 2 and "No such file" in done.stderr and done.stderr.count("\n") == 1


def test_a_full_disk_ends_the_run_with_one_line_and_leaves_all_before_whole(tmp_path):
    done = run("--out", tmp_path, *CELL, "--checkpoint-every", "0.01", preexec_fn=limit_file_size)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert f"cannot write {tmp_path}" in done.stderr and "files written before it are whole" in done.stderr
    assert assert_readable(tmp_path) > 0
    read_checkpoint(tmp_path / "checkpoint.h5")
    assert [path.name for path in tmp_path.rglob("*.part")] == []


def limit_file_size():
    """No file may grow beyond this, as on a disk that is full: the XDMF does after some frames."""
    import resource
    import signal

    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))


def test_paraviews_reader_sees_what_is_in_the_files(unbroken):
    script = textwrap.dedent("""
        import sys
        try:
            from vtkmodules.vtkIOXdmf2 import vtkXdmfReader
        except ImportError:
            sys.exit(77)
        for name in "grains", "contacts":
            reader = vtkXdmfReader()
            reader.SetFileName(f"{sys.argv[1]}/{name}.xdmf")
            reader.UpdateInformation()
            executive = reader.GetExecutive()
            times = executive.GetOutputInformation(0).Get(executive.TIME_STEPS())
            reader.UpdateTimeStep(times[-1])
            grid = reader.GetOutputDataObject(0)
            data = grid.GetPointData() if name == "grains" else grid.GetCellData()
            arrays = sorted(data.GetArrayName(k) for k in range(data.GetNumberOfArrays()))
            print(len(times), grid.GetNumberOfPoints(), grid.GetNumberOfCells(), *arrays)
    """)
    done = subprocess.run(["/usr/bin/python3", "-c", script, unbroken], capture_output=True, text=True)
    if done.returncode == 77:
        pytest.skip("python3-paraview is not installed")
    assert done.returncode == 0, done.stderr
    with h5py.File(unbroken / "run.h5") as index:
        last = list(index["frames"].values())[-1]
        n, m = len(last["grains/radius"]), len(last["contacts/force"])
    grains_line, contacts_line = done.stdout.splitlines()
    assert grains_line == f"21 {n} {n} radius spin velocity"
    assert contacts_line.split()[1:] == f"{2 * m} {m} force force_normal grain_i grain_j".split()
