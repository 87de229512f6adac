"""Commands as users type them."""

from analytic_rasterizer import cli


def words_of(*given) -> list[str]:
    """Text is split at its spaces; anything else, such as a path, is one word."""
    return [word for part in given for word in (part.split(" ") if isinstance(part, str) else [str(part)])]


def command(*given) -> int:
    """Exit code of what `words_of` makes of this."""
    return cli.main(words_of(*given))


def train(capture, out, *options) -> int:
    """On the CPU, also where there is a GPU."""
    return command("train", capture, "--out", out, "--device cpu", *options)


def evaluate(folder, *options) -> int:
    """Without what takes long or is on the network."""
    return command("evaluate", folder, "--lpips none --pictures 0", *options)


def refused(capsys, run, *given, prints=True) -> str:
    """What run(*given), one of these, says of a mistake in one line, with exit code 2. `prints`: other things too."""
    capsys.readouterr()
    try:
        code = run(*given)
    except SystemExit as stop:  # how argparse leaves
        code = stop.code
    printed, error = capsys.readouterr()
    assert prints or printed == ""
    assert code == 2 and error.startswith("error: ") and error.count("\n") == 1, error
    return error
