"""A small case to break: a motor-driven pendulum, simulated by MuJoCo, with a recording that its model explains."""

import functools

import mujoco
import numpy as np

MODEL = """
<mujoco model="rig">
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -2"/>
    <body name="bob" pos="0 0 0">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.05"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" density="0"/>
      <geom name="ball" type="sphere" pos="0 0 -0.4" size="0.05" mass="0.3"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="1" ctrlrange="-2 2"/></actuator>
  <sensor><jointpos name="encoder" joint="hinge"/></sensor>
</mujoco>
"""

CASE = """
schema = 1
name = "rig"
model = "model.xml"
recordings = "recordings/*.csv"
horizon = 0.5

[[parameters]]
name = "bob_mass"
unit = "kg"
targets = ["body/bob/mass"]
prior = { distribution = "uniform", low = 0.15, high = 0.6 }
"""


@functools.cache
def _simulated(rows, dt):
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    data.qpos[0] = 1.0
    time = np.arange(rows) * dt
    ctrl = 0.4 * np.sin(3 * time)
    qpos, qvel = np.empty(rows), np.empty(rows)
    for i in range(rows):
        qpos[i], qvel[i] = data.qpos[0], data.qvel[0]
        data.ctrl[0] = ctrl[i]
        mujoco.mj_step(model, data, round(dt / model.opt.timestep))
    return time, qpos, qvel, ctrl


def columns(rows=400, dt=0.01):
    """The columns of a recording, fresh arrays."""
    time, qpos, qvel, ctrl = (x.copy() for x in _simulated(rows, dt))
    return {"time": time, "joint/hinge/qpos": qpos, "joint/hinge/qvel": qvel, "actuator/motor/ctrl": ctrl}


def csv_text(data):
    names = list(data)
    lines = [",".join(names)]
    lines += [",".join(str(data[name][i]) for name in names) for i in range(len(data["time"]))]
    return "\n".join(lines) + "\n"


def write_case(folder, case=CASE, model=MODEL, **recordings):
    """Write a case; recordings are texts or columns by file name without its ending, `run1` by default."""
    (folder / "recordings").mkdir(parents=True, exist_ok=True)
    (folder / "case.toml").write_text(case, encoding="utf-8")
    (folder / "model.xml").write_text(model, encoding="utf-8")
    for name, data in (recordings or {"run1": columns()}).items():
        text = data if isinstance(data, str) else csv_text(data)
        (folder / "recordings" / f"{name}.csv").write_text(text, encoding="utf-8")
    return folder
