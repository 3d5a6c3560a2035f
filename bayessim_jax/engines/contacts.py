"""Which geoms of a model can ever touch."""

from __future__ import annotations

import mujoco

__all__ = ["find_contact", "find_partners"]


def find_contact(model: mujoco.MjModel) -> tuple[str, str] | None:
    """Two geoms that MuJoCo's filters let collide, or None: bit masks, welded, parent and excluded bodies, pairs."""
    bit = mujoco.mjtDisableBit
    if model.opt.disableflags & (bit.mjDSBL_CONTACT | bit.mjDSBL_CONSTRAINT):
        return None
    if model.npair:
        return _name(model, int(model.pair_geom1[0])), _name(model, int(model.pair_geom2[0]))
    for one in range(model.ngeom):
        for two in find_partners(model, one):
            if two < one:
                return _name(model, two), _name(model, one)
    return None


def find_partners(model: mujoco.MjModel, geom: int) -> list[int]:
    """The geoms that MuJoCo's filters let one collide with, named pairs aside."""
    excluded = {int(signature) for signature in model.exclude_signature}
    others = [other for other in range(model.ngeom) if other != geom]
    return [o for o in others if _masks_meet(model, geom, o) and _bodies_meet(model, geom, o, excluded)]


def _masks_meet(model: mujoco.MjModel, one: int, two: int) -> bool:
    type_, affinity = model.geom_contype, model.geom_conaffinity
    return bool(type_[one] & affinity[two] or type_[two] & affinity[one])


def _bodies_meet(model: mujoco.MjModel, one: int, two: int, excluded: set[int]) -> bool:
    bodies = sorted((int(model.geom_bodyid[one]), int(model.geom_bodyid[two])))
    if (bodies[0] << 16) + bodies[1] in excluded:
        return False
    weld = [int(model.body_weldid[b]) for b in bodies]
    if weld[0] == weld[1]:
        return False
    above = [int(model.body_weldid[model.body_parentid[w]]) for w in weld]
    kin = 0 not in weld and (weld[0] == above[1] or weld[1] == above[0])
    return not kin or bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)


def _name(model: mujoco.MjModel, geom: int) -> str:
    return f"geom/{model.geom(geom).name or f'#{geom}'}"
