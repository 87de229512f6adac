"""Commands as users type them."""

from analytic_rasterizer import cli


def command(*given) -> int:
    """Exit code. Text is split at its spaces; anything else, such as a path, is one word."""
    words = [word for part in given for word in (part.split(" ") if isinstance(part, str) else [str(part)])]
    return cli.main(words)


def train(capture, out, *options) -> int:
    """On the CPU, also where there is a GPU."""
    return command("train", capture, "--out", out, "--device cpu", *options)


def evaluate(folder, *options) -> int:
    """Without what takes long or is on the network."""
    return command("evaluate", folder, "--lpips none --pictures 0", *options)
