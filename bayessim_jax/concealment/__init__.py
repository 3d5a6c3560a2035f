"""Machines with something concealed in them: laws of physics that a model lacks, and motions that show them."""

from bayessim_jax.concealment.law import ModelLaw
from bayessim_jax.concealment.motions import KINDS
from bayessim_jax.concealment.registry import LAWS, UNKNOWN, choose_place, lookup_law
from bayessim_jax.concealment.scene import Scene, StillError, make_scene
from bayessim_jax.concealment.search import Hidden, StrengthError, hide
from bayessim_jax.concealment.world import RunawayError, Track

__all__ = [
    "KINDS",
    "LAWS",
    "UNKNOWN",
    "Hidden",
    "ModelLaw",
    "RunawayError",
    "Scene",
    "StillError",
    "StrengthError",
    "Track",
    "choose_place",
    "hide",
    "lookup_law",
    "make_scene",
]
