"""The blocks of README and docs, run as a reader would type them: in order, in one folder, in one Python session.

* ```sh: lines that begin with nbs-pin or python are run.
* ```python: executed; the names of earlier blocks stay.
* any block with a title="NAME" is written to that file.
* ```shell: what a test cannot do (make, pip, a queue); `typed_by_hand` lists the lines, which are checked otherwise.
"""

import contextlib
import re
import runpy
import shlex
import sys
import textwrap
from pathlib import Path
from unittest.mock import patch

from nbs_pin import cli

_FENCE = re.compile(r"^(?P<indent> *)```(?P<kind>[\w-]+)(?P<rest>[^\n]*)\n(?P<body>.*?)^(?P=indent)```$", re.M | re.S)


def blocks(page):
    """(kind, title, text) of every fenced block."""
    for found in _FENCE.finditer(page.read_text()):
        title = re.search(r'title="([^"]+)"', found["rest"])
        yield found["kind"], title and title[1], textwrap.dedent(found["body"])


def lines(text):
    """The commands of a shell block as lists of words; a comment ends a line, a backslash continues it."""
    return [words for line in text.replace("\\\n", " ").splitlines() if (words := shlex.split(line, comments=True))]


def commands(page):
    """Every nbs-pin command of a page, as words after `nbs-pin`."""
    return [
        words[1:] for kind, _, text in blocks(page) if kind == "sh" for words in lines(text) if words[0] == "nbs-pin"
    ]


def typed_by_hand(page):
    return [words for kind, _, text in blocks(page) if kind == "shell" for words in lines(text)]


def run_page(page, folder):
    """Runs the page in the folder; a failure names the block or the command."""
    namespace = {"__name__": "page"}
    with contextlib.chdir(folder):
        for number, (kind, title, text) in enumerate(blocks(page), 1):
            if title:
                Path(title).parent.mkdir(parents=True, exist_ok=True)
                Path(title).write_text(text)
            elif kind == "python":
                exec(compile(text, f"{page.name}, block {number}", "exec"), namespace)
            elif kind == "sh":
                for words in lines(text):
                    _run(words, page)


def _run(words, page):
    if words[0] == "python":
        with patch.object(sys, "argv", words[1:]):
            runpy.run_path(words[1], run_name="__main__")
        return
    assert words[0] == "nbs-pin", f"{page.name}: '{words[0]}' is not run by a test; put it in a ```shell block"
    code = cli.main(words[1:])
    assert code == 0, f"{page.name}: {' '.join(words)} ended with {code}"
