"""Checkpoints: everything a run needs to go on bit for bit, in one file that is whole or not there."""

import json
import zlib

import numpy as np

from quicksand.grains import __version__
from quicksand.grains.frames import hdf5_bytes, write_whole


def write_checkpoint(path, parameters, parts):
    """Write a checkpoint.

    Parameters
    ----------
    path : pathlib.Path
    parameters : str
        Flags of the study, JSON.
    parts : dict of dict
        Arrays, numbers and strings by part and name.
    """

    def fill(file):
        file.attrs["version"], file.attrs["parameters"] = __version__, parameters
        for part, values in parts.items():
            for name, value in values.items():
                value = np.asarray(value)
                if value.dtype.kind == "U":
                    value = np.frombuffer(str(value).encode(), np.uint8)
                data = file.create_dataset(f"{part}/{name}", data=value)
                data.attrs["crc32"] = zlib.crc32(np.ascontiguousarray(value))

    write_whole(path, hdf5_bytes(fill), sync=True)


def read_checkpoint(path):
    """Read what `write_checkpoint` wrote: (parameters, parts).

    Raises
    ------
    ValueError
        The file is no checkpoint, damaged, cut short, or of another version.
    OSError
        There is no such file.
    """
    import h5py

    with open(path, "rb"):
        pass  # a plain reason where it cannot be read at all
    try:
        with h5py.File(path, "r") as file:
            version = file.attrs.get("version")
            if version is None or "parameters" not in file.attrs:
                raise ValueError(f"restart: {path} is no checkpoint")
            if version != __version__:
                raise ValueError(f"restart: {path} is of version {version}, but this is version {__version__}; restart with that version")
            parts = {part: {name: data[()] for name, data in group.items()} for part, group in file.items()}
            for part, group in file.items():
                for name, data in group.items():
                    if zlib.crc32(np.ascontiguousarray(parts[part][name])) != data.attrs["crc32"]:
                        raise OSError(f"{part}/{name} does not match its checksum")
            return json.loads(file.attrs["parameters"]), parts
    except (OSError, KeyError, RuntimeError) as error:
        raise ValueError(f"restart: {path} is damaged or cut short, use an older one ({error})") from error
