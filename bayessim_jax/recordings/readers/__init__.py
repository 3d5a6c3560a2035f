"""Tables out of recordings: one file per format behind `read_table`."""

from bayessim_jax.recordings.readers.table import SUFFIXES as SUFFIXES
from bayessim_jax.recordings.readers.table import Table as Table
from bayessim_jax.recordings.readers.table import read_table as read_table
