"""Plots that answer to the mouse: recording against predictions, and the model moving beside its ghosts.

One small script draws both on canvases; its hash stands in the page's content policy, so that nothing else runs.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_jax.report.html import escape

__all__ = ["SCRIPT", "SCRIPT_HASH", "animation", "compact", "script", "traces"]

SCRIPT = r"""
"use strict";
const INK = () => getComputedStyle(document.body).color;
const SOFT = "#8b929c";
function fit(canvas, height) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth;
  canvas.width = width * ratio; canvas.height = height * ratio; canvas.style.height = height + "px";
  const c = canvas.getContext("2d"); c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.font = "12px system-ui, sans-serif"; return [c, width];
}
function ticks(low, high, count) {
  const raw = (high - low) / count, power = Math.pow(10, Math.floor(Math.log10(raw)));
  const step = power * [1, 2, 5, 10].find(m => m * power >= raw), out = [];
  for (let x = Math.ceil(low / step) * step; x <= high + 1e-9 * step; x += step) out.push(+x.toPrecision(12));
  return out;
}
const show = x => String(+x.toPrecision(6)).replace("-", "\u2212");
for (const root of document.querySelectorAll(".traces")) {
  const data = JSON.parse(root.querySelector("script").textContent);
  const canvas = root.querySelector("canvas"), pick = root.querySelector("select");
  const reset = root.querySelector("button");
  const L = 62, R = 10, H = 150, GAP = 26;
  let view = null, span = null, drag = null;
  function draw() {
    const run = data.recordings[pick.value], n = data.channels.length;
    const [c, width] = fit(canvas, n * (H + GAP) + 22), W = width - L - R;
    span = [run.time[0], run.time[run.time.length - 1]]; if (!view) view = span.slice();
    const X = t => L + W * (t - view[0]) / (view[1] - view[0]);
    data.channels.forEach((channel, k) => {
      const top = 14 + k * (H + GAP), inside = run.time.map(t => t >= view[0] && t <= view[1]);
      let low = Infinity, high = -Infinity;
      for (const s of data.series) run[s.key][k].forEach((y, i) => {
        if (y !== null && inside[i] && s.scale) { low = Math.min(low, y); high = Math.max(high, y); } });
      if (!(high > low)) { low = (low || 0) - 1; high = low + 2; }
      const pad = 0.06 * (high - low); low -= pad; high += pad;
      const Y = y => top + H * (1 - (y - low) / (high - low));
      c.fillStyle = INK(); c.textAlign = "left"; c.fillText(channel.label, L, top - 3);
      c.strokeStyle = SOFT; c.lineWidth = 0.6; c.strokeRect(L, top, W, H);
      c.textAlign = "right"; c.fillStyle = SOFT;
      for (const y of ticks(low, high, 4)) { c.fillText(show(y), L - 6, Y(y) + 4);
        c.globalAlpha = 0.25; c.beginPath(); c.moveTo(L, Y(y)); c.lineTo(L + W, Y(y)); c.stroke(); c.globalAlpha = 1; }
      c.textAlign = "center";
      if (k === n - 1) { for (const t of ticks(view[0], view[1], 8)) c.fillText(show(t), X(t), top + H + 16);
        c.fillText("time [s]", L + W / 2, top + H + 32); }
      c.save(); c.beginPath(); c.rect(L, top, W, H); c.clip();
      for (const s of data.series) {
        const y = run[s.key][k]; c.strokeStyle = c.fillStyle = s.colour || INK(); c.lineWidth = s.width || 1.4;
        if (s.upper) { const up = run[s.upper][k]; c.globalAlpha = 0.2;
          for (let i = 1; i < y.length; i++) if (y[i] !== null && y[i-1] !== null && !run.start[i]) {
            c.beginPath(); c.moveTo(X(run.time[i-1]), Y(y[i-1])); c.lineTo(X(run.time[i]), Y(y[i]));
            c.lineTo(X(run.time[i]), Y(up[i])); c.lineTo(X(run.time[i-1]), Y(up[i-1])); c.fill(); }
          c.globalAlpha = 1; continue; }
        if (s.dots) { for (let i = 0; i < y.length; i++) if (y[i] !== null && inside[i])
            c.fillRect(X(run.time[i]) - 1, Y(y[i]) - 1, 2, 2); continue; }
        c.beginPath(); let pen = false;
        for (let i = 0; i < y.length; i++) {
          if (y[i] === null) { pen = false; continue; }
          if (run.start[i] || !pen) c.moveTo(X(run.time[i]), Y(y[i])); else c.lineTo(X(run.time[i]), Y(y[i]));
          pen = true; }
        c.stroke();
      }
      c.restore();
    });
  }
  canvas.addEventListener("wheel", e => { e.preventDefault();
    const box = canvas.getBoundingClientRect(), share = (e.clientX - box.left - L) / (box.width - L - R);
    const at = view[0] + share * (view[1] - view[0]), zoom = Math.exp(0.0015 * e.deltaY);
    view = [at - (at - view[0]) * zoom, at + (view[1] - at) * zoom];
    view = [Math.max(view[0], span[0]), Math.min(view[1], span[1])]; draw(); }, { passive: false });
  canvas.addEventListener("pointerdown", e => {
    drag = [e.clientX, view.slice()]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => { drag = null; });
  canvas.addEventListener("pointermove", e => { if (!drag) return;
    const move = (drag[0] - e.clientX) * (drag[1][1] - drag[1][0]) / (canvas.clientWidth - L - R);
    const keep = Math.max(Math.min(move, span[1] - drag[1][1]), span[0] - drag[1][0]);
    view = drag[1].map(x => x + keep); draw(); });
  canvas.addEventListener("dblclick", () => { view = null; draw(); });
  reset.addEventListener("click", () => { view = null; draw(); });
  pick.addEventListener("change", () => { view = null; draw(); });
  window.addEventListener("resize", draw); draw();
}
for (const root of document.querySelectorAll(".animation")) {
  const data = JSON.parse(root.querySelector("script").textContent), canvas = root.querySelector("canvas");
  const button = root.querySelector("button"), slider = root.querySelector("input");
  let frame = 0, playing = false, last = 0;
  const frames = data.time.length; slider.max = frames - 1;
  function draw() {
    const [c, width] = fit(canvas, 340), [x0, y0, x1, y1] = data.box;
    const scale = Math.min((width - 40) / (x1 - x0), 300 / (y1 - y0));
    const X = x => width / 2 + scale * (x - (x0 + x1) / 2), Y = y => 170 - scale * (y - (y0 + y1) / 2);
    for (const body of data.bodies) {
      c.strokeStyle = body.colour || INK(); c.globalAlpha = body.alpha; c.lineWidth = body.width; c.lineCap = "round";
      for (const [a, b, p, q] of body.frames[Math.min(frame, body.frames.length - 1)] || []) {
        c.beginPath(); c.moveTo(X(a), Y(b)); c.lineTo(X(p) + (a === p && b === q ? 0.1 : 0), Y(q)); c.stroke(); }
      c.globalAlpha = 1; }
    c.fillStyle = INK(); c.textAlign = "center";
    for (const [text, x, y] of data.labels) c.fillText(text, X(x), Y(y));
    c.fillStyle = SOFT; c.textAlign = "left"; c.fillText("t = " + show(data.time[frame]) + " s", 8, 16);
    slider.value = frame;
  }
  function tick(now) { if (!playing) return;
    if (now - last > 1000 * data.dt) { frame = (frame + 1) % frames; last = now; draw(); }
    requestAnimationFrame(tick); }
  button.addEventListener("click", () => { playing = !playing; button.textContent = playing ? "Pause" : "Play";
    if (playing) requestAnimationFrame(tick); });
  slider.addEventListener("input", () => { frame = +slider.value; draw(); });
  window.addEventListener("resize", draw); draw();
}
"""

SCRIPT_HASH = "sha256-" + base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()


def script() -> str:
    """The script itself, for the end of a page."""
    return f"<script>{SCRIPT}</script>"


def compact(values: np.ndarray, digits: int = 5) -> Any:
    """Nested lists with so many significant digits; what is not finite is null."""
    if values.ndim > 1:
        return [compact(v, digits) for v in values]
    return [float(f"{v:.{digits}g}") if math.isfinite(v) else None for v in values.tolist()]


def _key(label: str, colour: str) -> str:
    return f'<span class="key"><i style="background:{colour or "currentColor"}"></i>{escape(label)}</span>'


def _data(value: Any) -> str:
    """JSON that cannot end its element."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    return text.replace("<", "\\u003c")


def traces(
    recordings: Sequence[tuple[str, Mapping[str, Any]]],
    channels: Sequence[str],
    series: Sequence[Mapping[str, Any]],
    caption: str,
) -> str:
    """Recordings against predictions, a plot for each channel; the wheel zooms, dragging moves, a double click resets.

    Each recording maps `time` and `start` (where a prediction begins anew) to lists over rows, and every series' key
    to lists over channels and rows.
    """
    options = "".join(f'<option value="{i}">{escape(name)}</option>' for i, (name, _) in enumerate(recordings))
    content = _data(
        {"recordings": [r for _, r in recordings], "channels": [{"label": c} for c in channels], "series": list(series)}
    )
    keys = "".join(_key(str(s["label"]), str(s.get("colour", ""))) for s in series)
    return (
        f'<figure class="wide traces"><p class="controls"><select aria-label="Recording">{options}</select> '
        f'<button type="button">Reset zoom</button> {keys}</p>\n'
        f'<canvas role="img" aria-label="Recording against predictions over time."></canvas>\n'
        f'<script type="application/json">{content}</script>\n<figcaption>{escape(caption)}</figcaption></figure>'
    )


def animation(
    time: np.ndarray,
    bodies: Sequence[tuple[str, str, float, float, np.ndarray]],
    caption: str,
    alt: str = "The model replaying the recording, with simulated ghosts.",
    labels: Sequence[tuple[str, float, float]] = (),
    slower: float = 1.0,
) -> str:
    """Stick figures that move: for each a label, a colour, an opacity, a width and segments (frames, segments, 4).

    What does not move is one frame. `labels` are words and where they stand; time passes `slower` times as slowly.
    """
    every = np.concatenate([*(b[-1].reshape(-1, 2) for b in bodies), *(np.array([label[1:]]) for label in labels)])
    every = every[np.isfinite(every).all(1)]
    low, high = every.min(0), every.max(0)
    pad = 0.06 * max(float((high - low).max()), 1e-3)
    box = [float(x) for x in (*(low - pad), *(high + pad))]
    content = {
        "time": compact(time),
        "dt": slower * float(np.median(np.diff(time))) if len(time) > 1 else 0.1,
        "box": box,
        "labels": [list(label) for label in labels],
        "bodies": [
            {"colour": colour, "alpha": alpha, "width": width, "frames": compact(np.nan_to_num(frames), 4)}
            for _, colour, alpha, width, frames in bodies
        ],
    }
    keys = "".join(_key(label, colour) for label, colour, *_ in bodies)
    return (
        '<figure class="wide animation"><p class="controls"><button type="button">Play</button> '
        f'<input type="range" min="0" value="0" aria-label="Time"> {keys}</p>\n'
        f'<canvas role="img" aria-label="{escape(alt)}"></canvas>\n'
        f'<script type="application/json">{_data(content)}</script>\n'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )
