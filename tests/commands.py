"""What the tests of shell commands share: a folder read back, what was printed, and what every refusal looks like."""

import contextlib
import io
import json

from nbs_pin import cli


def printed_by(*arguments):
    """What a command that succeeds prints."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert cli.main([*map(str, arguments)]) == 0
    return printed.getvalue()


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def refusal(code, capsys):
    """The sentence of a command that ended with this code, which must be that of a refusal."""
    assert code == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.startswith("nbs-pin: error: ")
    assert printed.out == ""
    return line


def check_results_are_kept_unless_forced(run, folder, change, words, capsys):
    """The same command may be run twice; one with a change is refused in these words until it is forced."""
    assert run(folder) == run(folder) == 0
    capsys.readouterr()
    before = contents(folder)
    assert words in refusal(run(folder, *change), capsys)
    assert contents(folder) == before
    assert run(folder, *change, "--force") == 0
    assert contents(folder) != before
