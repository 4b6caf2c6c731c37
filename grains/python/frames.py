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
    lists what a frame holds). An XDMF file for each group of a frame shows it in ParaView: grains.xdmf, contacts.xdmf, fluid.xdmf.

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
        import h5py

        self.folder, self.parameters, self.count = Path(folder), parameters, count
        self.numbers = []  # of the frames in the folder
        self.grids = {}  # XDMF of each frame, by group
        (self.folder / "frames").mkdir(parents=True, exist_ok=True)
        later = []
        for path in sorted((self.folder / "frames").glob("*.h5")):
            if path.stem.isdigit() and int(path.stem) < count:
                with h5py.File(path) as frame:
                    self._take(path, frame.attrs["time"], frame)
            else:
                later.append(path)
        self._write_index()
        for path in later:  # the index leads to them no more
            path.unlink()

    def write(self, *parts, series=None):
        """Add a frame of the scene as it is now.

        Parameters
        ----------
        parts : Simulation, or whatever has `time` [s] and `frame()` -> {group: {name: array}}
            The first one's time is that of the frame. A group is a set of points with `position` (n, 3), or cells with `connectivity`
            (m, 2 to 10), and arrays for each point or cell.
        series : dict of (n,) arrays, optional
            Time series since the last frame.
        """
        groups, time = {}, parts[0].time
        for part in parts:
            groups |= part.frame() if hasattr(part, "frame") else {"grains": _grains(part), "contacts": _contacts(part)}

        def fill(file):
            file.attrs["time"] = time
            for group, arrays in groups.items():
                for name, values in arrays.items():
                    file[f"{group}/{name}"] = values
            if series:
                file["series"] = np.rec.fromarrays(list(series.values()), names=list(series))  # one dataset: it is read field by field

        path = self.folder / "frames" / f"{self.count:06d}.h5"
        write_whole(path, hdf5_bytes(fill))
        self.count += 1
        self._take(path, time, groups)
        self._write_index()

    def _take(self, path, time, frame):
        self.numbers.append(path.stem)
        for name in frame:
            if name != "series":
                self.grids.setdefault(name, []).append(_grid(frame[name], f"frames/{path.name}:/{name}", time))

    def _write_index(self):
        import h5py

        from ._grains import __version__

        def fill(file):
            file.attrs["version"], file.attrs["parameters"] = __version__, self.parameters
            frames = file.create_group("frames")
            for number in self.numbers:
                frames[number] = h5py.ExternalLink(f"frames/{number}.h5", "/")

        for name, grids in self.grids.items():
            text = (f'<?xml version="1.0"?>\n<Xdmf Version="2.0"><Domain>\n<Grid Name="{name}" GridType="Collection" '
                    f'CollectionType="Temporal">\n{"".join(grids)}</Grid>\n</Domain></Xdmf>\n')
            write_whole(self.folder / f"{name}.xdmf", text.encode())
        write_whole(self.folder / "run.h5", hdf5_bytes(fill))  # last: where it is, all else is


def _grains(sim):
    return {"position": _three(sim.position), "radius": sim.radius, "velocity": _three(sim.velocity), "spin": sim.spin}


def _contacts(sim):
    lines, contacts = contact_lines(sim)
    force = contacts["force_normal"][:, None] * contacts["normal"] + contacts["force_tangential"]
    return {"position": _three(lines.reshape(-1, lines.shape[-1])),
            "connectivity": np.arange(2 * len(lines), dtype=np.int32).reshape(-1, 2), "force": _three(force),
            "force_normal": contacts["force_normal"], "grain_i": contacts["grain_i"], "grain_j": contacts["grain_j"]}


def _three(vectors):
    """(n, 2) or (n, 3) as (n, 3), which is all that ParaView takes for vectors."""
    three = np.zeros((len(vectors), 3))
    three[:, :vectors.shape[1]] = vectors
    return three


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


CELLS = {2: 'TopologyType="Polyline" NodesPerElement="2"', 3: 'TopologyType="Triangle"', 4: 'TopologyType="Tetrahedron"', 6: 'TopologyType="Triangle_6"',
         10: 'TopologyType="Tetrahedron_10"'}  # by nodes of each


def _grid(arrays, place, time):
    """XDMF of one frame: points, or cells where there is a connectivity, and every array that has one value or vector for each."""
    points = len(arrays["position"])
    if not points:
        return ""  # readers stumble over empty grids
    if "connectivity" in arrays:
        number, nodes = arrays["connectivity"].shape
        topology, cells = f'{CELLS[nodes]} NumberOfElements="{number}"', _item(arrays, place, "connectivity")
    else:
        topology, cells = f'TopologyType="Polyvertex" NumberOfElements="{points}"', ""
    text = [f'<Grid Name="{place}" GridType="Uniform"><Time Value="{time:.12g}"/>\n<Topology {topology}>{cells}</Topology>\n',
            f'<Geometry GeometryType="XYZ">{_item(arrays, place, "position")}</Geometry>\n']
    for name in arrays:
        if name not in ("position", "connectivity"):
            rank = "Vector" if arrays[name].ndim == 2 else "Scalar"
            center = "Node" if len(arrays[name]) == points else "Cell"
            text.append(f'<Attribute Name="{name}" AttributeType="{rank}" Center="{center}">{_item(arrays, place, name)}</Attribute>\n')
    return "".join(text) + "</Grid>\n"


def _item(arrays, place, name):
    data = arrays[name]
    number = "Float" if data.dtype.kind == "f" else "Int"
    shape = " ".join(map(str, data.shape))
    return (f'<DataItem Dimensions="{shape}" NumberType="{number}" Precision="{data.dtype.itemsize}" Format="HDF">'
            f"{place}/{name}</DataItem>")
