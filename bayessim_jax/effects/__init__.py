"""Physical effects that simulators lack: what each does at which port, and how to put them into a simulator."""

from bayessim_jax.effects.attach import effect_places as effect_places
from bayessim_jax.effects.attach import with_effects as with_effects
from bayessim_jax.effects.contract import ActEffect as ActEffect
from bayessim_jax.effects.contract import Effect as Effect
from bayessim_jax.effects.contract import EffectParameter as EffectParameter
from bayessim_jax.effects.contract import ForceEffect as ForceEffect
from bayessim_jax.effects.contract import ModelEffect as ModelEffect
from bayessim_jax.effects.contract import Moment as Moment
from bayessim_jax.effects.contract import Scales as Scales
from bayessim_jax.effects.contract import SenseEffect as SenseEffect
from bayessim_jax.effects.mjcf_edits import write_mjcf as write_mjcf
from bayessim_jax.effects.open_form import open_form as open_form
from bayessim_jax.effects.places import at as at
from bayessim_jax.effects.places import joints as joints
from bayessim_jax.effects.registry import EFFECTS as EFFECTS
from bayessim_jax.effects.registry import lookup_effect as lookup_effect
from bayessim_jax.effects.registry import register_effect as register_effect
from bayessim_jax.effects.scaling import commanded_scales as commanded_scales
from bayessim_jax.effects.scaling import recorded_scales as recorded_scales
