"""Modules of the jobs, loaded once in the process from which all jobs are forked.

Typer is among them: the process of a job executes the program's main module again, which is the command line.
"""

import numpy as np
import pyarrow.csv
import scipy.optimize
import scipy.sparse.linalg
import typer

import rtec.api
import rtec.characterise
import rtec.diagnosis.compare.compare
import rtec.diagnosis.extend.improve
import rtec.metrology.files.load
import rtec.report.compare
import rtec.report.diagnosis
import rtec.report.history
import rtec.sim.campaign.campaign
import rtec.tasks.foreign
import rtec.tasks.model
from rtec.effects.derived import direction_track

__all__ = ["np", "pyarrow", "rtec", "scipy", "typer"]

# The first call of a compiled function makes numba load everything, which takes longer than all the rest.
direction_track(np.zeros(2), 0.0)
