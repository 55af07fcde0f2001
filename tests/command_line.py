"""The command line as tests call it."""

from stga_addon.cli.main import main


def stga(*words):
    """Exit code of a command; texts are divided at spaces, paths and numbers are not."""
    parts = [word.split() if isinstance(word, str) else [str(word)] for word in words]
    return main([text for part in parts for text in part])


def refused(capsys, *words):
    """Run a command that must fail: exit code 2 and one sentence on stderr, which is returned."""
    capsys.readouterr()
    assert stga(*words) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("stga: ")]
    assert len(lines) == 1
    return lines[0]
