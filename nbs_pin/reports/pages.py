"""Pages for the browser: one file each that holds its scripts, styles and data, and can reach no address."""

import base64
import html
import importlib.resources
import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

_PARTS = ("page.css", "clock.js", "charts.js", "scene.js", "uPlot.iife.min.js", "uPlot.min.css", "uPlot.LICENSE")
"""Files beside the templates that every page contains, each at the placeholder of its name."""
_HEAD = "head.html"
"""The first lines of every template."""


def page(template: str, title: str, data: Mapping[str, Any], **more: str) -> bytes:
    """The template with its placeholders filled in one pass, so that content is never read as a placeholder.

    more: HTML for further placeholders.
    """
    folder, viewer = importlib.resources.files("nbs_pin.reports") / "assets", _viewer()
    holes = {name: (folder / name).read_text(encoding="utf-8") for name in _PARTS}
    first, _, holes["uPlot.iife.min.js"] = holes["uPlot.iife.min.js"].partition("\n")  # a comment with its address
    holes |= more | {
        "title": html.escape(title),
        "licences": html.escape(f"{first}\n{holes['uPlot.LICENSE']}\n\n{viewer['main.min.js.LICENSE.txt']}"),
        "meshcat": viewer["main.min.js"],
        # "<" would let a name end the script element
        "data": json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
    }
    head, text = ((folder / name).read_text(encoding="utf-8") for name in (_HEAD, template))
    text = text.replace(f"{{{{{_HEAD}}}}}\n", head)  # it has placeholders of its own
    return re.sub(r"\{\{([\w.]+)\}\}", lambda hole: holes[hole[1]], text).encode()


def _viewer() -> dict[str, str]:
    folder = importlib.resources.files("meshcat") / "viewer" / "dist"
    return {name: (folder / name).read_text(encoding="utf-8") for name in ("main.min.js", "main.min.js.LICENSE.txt")}


def written(text: str) -> str:
    """A text as HTML, in which no number such as 1e-7 is broken at its minus."""
    return unbroken(html.escape(text))


def unbroken(content: str) -> str:
    """HTML without scripts, with the same done to the numbers between its tags."""
    keep = r'<span class="number">\g<0></span>'
    return re.sub(r"[^<>]+(?=<|$)", lambda between: re.sub(r"[-−+]?\d[\d.]*[eE][-+−]\d+", keep, between[0]), content)


def encoded(array: np.ndarray, dtype: type[np.floating[Any]] = np.float32) -> str:
    """The numbers as base64, little-endian, for a typed array of the page."""
    return base64.b64encode(np.ascontiguousarray(array, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()).decode()
