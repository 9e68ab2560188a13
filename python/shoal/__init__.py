"""Start, watch and use runs of Shoal from Python.

>>> import shoal
>>> run = shoal.train("pendulum", steps=20_000, set={"evaluation.every": 2_000})   # doctest: +SKIP
>>> run.evaluations["return_mean"][-1]                                              # doctest: +SKIP
-151.2
>>> policy = run.policy("best")                                                     # doctest: +SKIP
>>> policy([1.0, 0.0, 0.0])                                                         # doctest: +SKIP
array([0.03], dtype=float32)

The package calls the program ``shoal`` and reads the files of its runs. It finds the program through the environment
variable ``SHOAL``, in its own installation, in ``PATH``, or beside the Python interpreter. Reading a run needs no
program.
"""

from .errors import ShoalError
from .policy import Policy
from .program import train, train_suite
from .run import Run
from .suite import Suite
from .transitions import Transitions

__all__ = ["Policy", "Run", "ShoalError", "Suite", "Transitions", "train", "train_suite"]
