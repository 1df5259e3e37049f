"""The page of a live view, as a template of Vue, which trame compiles in the browser.

Names in the template are those of the state that page and server share (`display` sets it).
`trigger('name')` calls the action of that name (`controls` lists them).
"""

from __future__ import annotations

from typing import NamedTuple

from autdtorch.plot.explore.situation import SCENE_PLANE


class CameraButton(NamedTuple):
    """A button that moves the camera: its label, its title, and the arguments of `Rendering.move_camera`."""

    label: str
    title: str
    move: tuple[float, float, float]


CAMERA = {
    "look_left": CameraButton("←", "look from further left", (15.0, 0.0, 1.0)),
    "look_right": CameraButton("→", "look from further right", (-15.0, 0.0, 1.0)),
    "look_up": CameraButton("↑", "look from further up", (0.0, 15.0, 1.0)),
    "look_down": CameraButton("↓", "look from further down", (0.0, -15.0, 1.0)),
    "zoom_in": CameraButton("+", "zoom in", (0.0, 0.0, 1.25)),
    "zoom_out": CameraButton("-", "zoom out", (0.0, 0.0, 0.8)),
    "look_first": CameraButton("First view", "first view", (0.0, 0.0, 0.0)),
}
"""Buttons of the camera, by action."""


def _slider(
    name: str, label: str, low: str, high: str, step: float, disabled: str = "false", spoken: str = ""
) -> str:
    """Return a slider and a number; `spoken` is the label for screen readers, if it differs."""
    return f"""
<label class="slider"><span>{label}</span>
  <input type="range" id="{name}" v-model.number="{name}" :min="{low}" :max="{high}" step="{step}"
    :disabled="{disabled}" @change="settled += 1">
  <input type="number" id="{name}_number" aria-label="{spoken or label}" v-model.lazy.number="{name}"
    :min="{low}" :max="{high}" step="any" :disabled="{disabled}" @change="settled += 1">
</label>"""


def _position(name: str, disabled: str = "false") -> str:
    return "".join(
        _slider(f"{name}_{axis}", f"{axis} [mm]", f"range_{axis}[0]", f"range_{axis}[1]", 0.1, disabled)
        for axis in "xyz"
    )


def _choice(name: str, label: str, options: str) -> str:
    return f"""
<label>{label}
  <select id="{name}" v-model="{name}">
    <option v-for="one in {options}" :key="one[0]" :value="one[0]">{{{{ one[1] }}}}</option>
  </select>
</label>"""


def _number(name: str, label: str) -> str:
    return f"""
<label>{label}
  <input type="number" id="{name}" v-model.lazy.number="{name}" step="any">
</label>"""


def _box(name: str, label: str) -> str:
    return f"""
<label class="box"><input type="checkbox" id="{name}" v-model="{name}"><span>{label}</span></label>"""


def _button(name: str, label: str, disabled: str = "false") -> str:
    return f"""
<button type="button" id="{name}" @click="trigger('{name}')" :disabled="{disabled}">{label}</button>"""


def _camera_button(name: str, look: CameraButton) -> str:
    return f"""
<button type="button" id="{name}" title="{look.title}" aria-label="{look.title}"
  @click="trigger('{name}')">{look.label}</button>"""


def page(view: str) -> str:
    """Return the template of the page around the template of the picture, `view`."""
    height = _slider(
        "height", f"{{{{ plane === '{SCENE_PLANE}' ? 'shifted by' : 'at' }}}} [mm]", "range_height[0]",
        "range_height[1]", 0.5, spoken="place of the plane [mm]",
    )  # fmt: skip
    looks = "".join(_camera_button(name, look) for name, look in CAMERA.items())
    turns = "".join(
        _slider(f"turn_{axis}", f"turn about {axis} [°]", "-180", "180", 1, "!body_turns") for axis in "xyz"
    )
    return f"""
<header>
  <h1>autdtorch explore: {{{{ name }}}}</h1>
</header>
<section class="tools" aria-label="search and history">
  {_choice("method", "method", "methods")}
  {_button("find", "Find the phases", "busy")} {_button("cancel", "Cancel", "!busy")}
  {_button("undo", "Undo", "!can_undo")} {_button("redo", "Redo", "!can_redo")}
  <span id="status" role="status">{{{{ status }}}}</span>
  <progress max="100" :value="progress" aria-label="progress of the method" v-show="busy"></progress>
</section>
<main>
  <section class="picture" aria-label="picture and readings" :aria-busy="shown != wanted" :data-shown="shown">
    <p id="message" role="alert">{{{{ message }}}}</p>
    <div class="view" role="img" :aria-label="summary">{view}</div>
    <div class="legends">
      <div class="legend" title="grey: in obstacles, behind reflectors and next to transducers">
        <span>{{{{ scale_low }}}}</span><span class="bar" :style="scale_style"></span>
        <span>{{{{ scale_high }}}}</span>
      </div>
      <div class="legend" title="of the transducers; light grey: silent">
        <span>phase 0°</span><span class="bar" :style="phase_style"></span><span>360°</span>
      </div>
      <div class="row" role="group" aria-label="camera">{looks}</div>
    </div>
    <p id="summary" aria-live="polite">{{{{ summary }}}}</p>
    <p class="hint">Drag an obstacle or a focus to move it at its height, with Ctrl or Alt to lift it, an
      obstacle with Shift to turn it. Click a transducer to choose it. Drag elsewhere to look around, scroll
      to zoom. Grey is in obstacles, behind reflectors and next to transducers; light grey transducers are
      silent.</p>
    <div class="scroll" tabindex="0" role="region" aria-label="pressures">
      <table>
        <caption>Pressure at the foci</caption>
        <thead><tr><th scope="col" v-for="title in columns" :key="title">{{{{ title }}}}</th></tr></thead>
        <tbody>
          <tr v-for="row in rows" :key="row[0]">
            <th scope="row">{{{{ row[0] }}}}</th>
            <td v-for="(cell, number) in row.slice(1)" :key="number">{{{{ cell }}}}</td>
          </tr>
        </tbody>
      </table>
    </div>
    <figure v-if="camera">
      <img id="camera" :src="camera" :alt="camera_text"><figcaption>{{{{ camera_text }}}}</figcaption>
    </figure>
    <details>
      <summary id="write_python" @click="trigger('write_python')">Python</summary>
      <button type="button" data-copy="python">Copy</button>
      <p class="hint" v-if="python.includes('path=')">It reads files that Save writes.</p>
      <pre id="python" tabindex="0">{{{{ python }}}}</pre>
    </details>
  </section>
  <section class="controls" aria-label="controls">
    <fieldset v-if="bodies.length"><legend>Obstacle</legend>
      {_choice("body", "obstacle", "bodies")} {_position("body", "!body_moves")} {turns}
      <p id="force" aria-live="polite">{{{{ force }}}}</p>
    </fieldset>
    <fieldset><legend>Focus</legend>
      {_choice("focus", "focus", "foci")} {_position("focus")}
      <div class="row">{_button("add_focus", "Add a focus")}
        {_button("remove_focus", "Remove it", "foci.length < 2")}</div>
    </fieldset>
    <fieldset><legend>Drive</legend>
      {_box("follow", "find the phases again after every move, by gradient ascent")}
      <label>transducer, or click one
        <input type="number" id="transducer" v-model.lazy.number="transducer" min="0" :max="transducers - 1">
      </label>
      {_slider("phase", "phase [°]", "0", "360", 1)} {_slider("amplitude", "amplitude", "0", "1", 0.01)}
      <div class="row">{_button("in_phase", "All in phase")}</div>
    </fieldset>
    <fieldset><legend>Field</legend>
      {_choice("plane", "plane across", "planes")}
      {height}
      {_choice("unit", "unit", "units")} {_number("reference", "brightest [Pa]")}
      <div class="row">{_button("rescale", "Fit the colours")}</div>
      {_box("volume", "surface of equal level in the volume")} {_number("surface", "at [dB]")}
    </fieldset>
    <fieldset><legend>Save</legend>
      <label>folder <input type="text" id="folder" v-model="folder"></label>
      {_choice("device", "levels for", "devices")}
      <div class="row">{_button("save", "Save scene and drive")}</div>
      <p id="saved" role="status">{{{{ saved }}}}</p>
    </fieldset>
  </section>
</main>"""
