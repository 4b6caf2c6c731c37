"""Grains by Non-Smooth Contact Dynamics: the compiled solver and its Python helpers.

Holds nothing of its own. Importing it loads numpy and the compiled module only; scipy, matplotlib and
tqdm are imported where they are used.
"""

from ._grains import __version__, NotConverged, Simulation, Simulation2D, Simulation3D, StepReport2D, StepReport3D, Wall2D, Wall3D
from .contact_problem import ContactProblem, Solution, contact_problem, read_fclib, read_solution, write_fclib
from .frames import Frames, contact_lines
from .packing import hexagonal_lattice, uniform_radii
from .profiles import Profile, Profiles
from .steady_state import BlockAverage, SteadyState, block_average, detect_steady_state, ratio_error
