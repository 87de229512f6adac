"""The calls of the package's own ops, recorded."""

from torch.utils._python_dispatch import TorchDispatchMode


class Calls(TorchDispatchMode):
    """Records the arguments of the first call of every op of ours."""

    def __init__(self):
        super().__init__()
        self.first = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.namespace == "analytic_rasterizer":
            self.first.setdefault(func._schema.name.split("::")[1], (func, args))
        return func(*args, **(kwargs or {}))
