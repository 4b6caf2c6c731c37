"""Frames of a scene on disk: HDF5 for any reader, XDMF beside it for ParaView.

A frame is a file of its own, written whole under another name and then renamed, like the index and the XDMF files: whatever kills
the run, and at whatever moment, what is there can be read.
"""

import os
import tempfile
from pathlib import Path

import numpy as np


def write_whole(path, data, sync=False):
    """Write bytes to a file: a reader, and a crash, sees the old file or the whole new one.

    Parameters
    ----------
    path : pathlib.Path
    data : bytes
    sync : bool
        Wait until the data are on the disk: they then survive a loss of power, too.

    Raises
    ------
    OSError
        Names the file and the reason. Nothing is left behind, and an old file stays as it was.
    """
    try:
        handle, part = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".part")
        try:
            with open(handle, "wb") as file:
                file.write(data)
                file.flush()
                if sync:
                    os.fsync(file.fileno())
                os.fchmod(file.fileno(), 0o644)  # mkstemp makes it 0600
            os.replace(part, path)
        except BaseException:
            os.unlink(part)
            raise
    except OSError as error:
        raise OSError(f"cannot write {path}: {error.strerror or error}; files written before it are whole") from error


def hdf5_bytes(fill):
    """Contents of an HDF5 file that `fill(file)` has filled: made in memory, because HDF5 itself does not survive a full disk."""
    import h5py

    with h5py.File("in memory", "w", driver="core", backing_store=False) as file:
        fill(file)
        file.flush()
        return file.id.get_file_image()


class Frames:
    """Writes the frames of a run into a folder.

    run.h5 leads to all: attributes `version`, `parameters` (JSON); `frames/000000` ... link to frames/000000.h5 ... (docs/output.md
    lists what a frame holds). grains.xdmf and contacts.xdmf show them in ParaView.

    Parameters
    ----------
    folder : pathlib.Path
        Frames that it holds from `count` on are removed.
    parameters : str
        Kept in run.h5, for instance as JSON.
    count : int
        Frames that the run has written before it was restarted.
    """

    def __init__(self, folder, parameters="{}", count=0):
        self.folder, self.parameters, self.count = Path(folder), parameters, count
        self.times = {}  # of the frames in the folder, by number [s]
        self.grids = {"grains": [], "contacts": []}  # XDMF of each frame
        (self.folder / "frames").mkdir(parents=True, exist_ok=True)
        for path in sorted((self.folder / "frames").glob("*.h5")):
            if path.stem.isdigit() and int(path.stem) < count:
                self._take(path)
            else:
                path.unlink()
        self._write_index()

    def write(self, sim, series=None):
        """Add a frame of the scene as it is now.

        Parameters
        ----------
        sim : Simulation
        series : dict of (n,) arrays, optional
            Time series since the last frame.
        """
        path = self.folder / "frames" / f"{self.count:06d}.h5"
        write_whole(path, hdf5_bytes(lambda file: _fill(file, sim, series or {})))
        self.count += 1
        self._take(path)
        self._write_index()

    def _take(self, path):
        import h5py

        with h5py.File(path) as frame:
            self.times[int(path.stem)] = frame.attrs["time"]
            for name, topology in (("grains", "Polyvertex"), ("contacts", "Polyline")):
                grid = _grid(frame[name], f"{path.parent.name}/{path.name}:/{name}", topology, frame.attrs["time"])
                self.grids[name].append(grid)

    def _write_index(self):
        import h5py

        from ._grains import __version__

        def fill(file):
            file.attrs["version"], file.attrs["parameters"] = __version__, self.parameters
            frames = file.create_group("frames")
            for number in self.times:
                frames[f"{number:06d}"] = h5py.ExternalLink(f"frames/{number:06d}.h5", "/")

        write_whole(self.folder / "run.h5", hdf5_bytes(fill))
        for name, grids in self.grids.items():
            text = (f'<?xml version="1.0"?>\n<Xdmf Version="2.0"><Domain>\n<Grid Name="{name}" GridType="Collection" '
                    f'CollectionType="Temporal">\n{"".join(grids)}</Grid>\n</Domain></Xdmf>\n')
            write_whole(self.folder / f"{name}.xdmf", text.encode())


def _fill(file, sim, series):
    file.attrs["time"] = sim.time
    position = _three(sim.position)
    grains = file.create_group("grains")
    grains["position"], grains["radius"] = position, sim.radius
    grains["velocity"], grains["spin"] = _three(sim.velocity), sim.spin

    lines, contacts = contact_lines(sim)
    group = file.create_group("contacts")
    group["position"] = _three(lines.reshape(-1, lines.shape[-1]))
    group["connectivity"] = np.arange(2 * len(lines), dtype=np.int32).reshape(-1, 2)
    group["force"] = _three(contacts["force_normal"][:, None] * contacts["normal"] + contacts["force_tangential"])
    group["force_normal"], group["grain_i"], group["grain_j"] = contacts["force_normal"], contacts["grain_i"], contacts["grain_j"]

    for name, values in series.items():
        file[f"series/{name}"] = values


def _three(vectors):
    """(n, 2) or (n, 3) as (n, 3), which is all that ParaView takes for vectors."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


def contact_lines(sim):
    """Load-bearing contacts as lines from centre to centre.

    At a wall, or at a grain fixed to one, a line ends in the contact. Lines are not cut at the ends of a period: they start inside.

    Returns
    -------
    lines : (n, 2, dim) array
        [m]
    contacts : dict
        As `Simulation.contacts()`.
    """
    contacts, position = sim.contacts(), sim.position
    i, j, point = contacts["grain_i"], contacts["grain_j"], contacts["point"]

    def centre(grain):
        return np.where((grain >= 0)[:, None], position[np.maximum(grain, 0)], point) if len(position) else point

    start, branch = centre(i), centre(j) - centre(i)
    for axis, period in enumerate(sim.period):
        if period > 0:
            branch[:, axis] -= period * np.round(branch[:, axis] / period)
            start[:, axis] -= period * np.round(start[:, axis] / period)
    return np.stack([start, start + branch], axis=1), contacts


def _grid(group, place, topology, time):
    """XDMF of one frame: points or lines, and every array that has one value or vector for each."""
    points, count = len(group["position"]), len(group["radius"] if "radius" in group else group["connectivity"])
    cells = _item(group, place, "connectivity") if "connectivity" in group else ""
    kind = ' NodesPerElement="2"' if cells else ""
    text = [f'<Grid Name="{place}" GridType="Uniform"><Time Value="{time:.12g}"/>\n',
            f'<Topology TopologyType="{topology}"{kind} NumberOfElements="{count}">{cells}</Topology>\n',
            f'<Geometry GeometryType="XYZ">{_item(group, place, "position")}</Geometry>\n']
    for name in group:
        if name in ("position", "connectivity") or not points:
            continue
        rank = "Vector" if group[name].ndim == 2 else "Scalar"
        center = "Cell" if cells else "Node"
        text.append(f'<Attribute Name="{name}" AttributeType="{rank}" Center="{center}">{_item(group, place, name)}</Attribute>\n')
    return "".join(text) + "</Grid>\n" if points else ""  # readers stumble over empty grids


def _item(group, place, name):
    data = group[name]
    number = "Float" if data.dtype.kind == "f" else "Int"
    shape = " ".join(map(str, data.shape))
    return (f'<DataItem Dimensions="{shape}" NumberType="{number}" Precision="{data.dtype.itemsize}" Format="HDF">'
            f"{place}/{name}</DataItem>")
