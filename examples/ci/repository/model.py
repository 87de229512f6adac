"""The Gaussians of a repository that was written for CUDA: parameters, optimiser and density control."""

import torch
from torch import nn

NAMES = ("means", "colors", "opacities", "scales", "rotations")
RATES = {"means": 5e-3, "colors": 5e-2, "opacities": 1e-1, "scales": 2e-2, "rotations": 1e-3}


class Model:
    def __init__(self, points, colors):
        """points, colors: (P, 3) arrays."""
        means = torch.tensor(points, dtype=torch.float32, device="cuda")
        count = means.shape[0]
        values = {
            "means": means,
            "colors": torch.logit(torch.tensor(colors).float().cuda().clamp(0.01, 0.99)),
            "opacities": torch.full((count, 1), -1.0, device="cuda"),
            "scales": torch.full((count, 3), -2.0).cuda(),
            "rotations": torch.tensor([[1.0, 0.0, 0.0, 0.0]], device="cuda").repeat(count, 1),
        }
        for name, value in values.items():
            setattr(self, name, nn.Parameter(value))
        self.optimizer = torch.optim.Adam(
            [{"params": [getattr(self, name)], "lr": RATES[name], "name": name} for name in NAMES], eps=1e-15
        )
        self.forget_gradients()

    def forget_gradients(self):
        self.gradients = torch.zeros(self.means.shape[0], device="cuda")
        self.views = torch.zeros(self.means.shape[0], device="cuda")

    def gather(self, screen_points, radii):
        """Adds up how far the loss wants to move the Gaussians that a view shows, in the image."""
        seen = radii > 0
        self.gradients[seen] += screen_points.grad[seen, :2].norm(dim=-1)
        self.views[seen] += 1

    @torch.no_grad()
    def densify(self, threshold, largest, least_opacity=0.005):
        """Splits the large Gaussians of large gradients, copies the small ones, drops the transparent ones."""
        wanted = self.gradients / self.views.clamp_min(1) > threshold
        large = self.scales.exp().amax(-1) > largest
        copied, split = wanted & ~large, wanted & large
        kept = ~split & (self.opacities.sigmoid()[:, 0] > least_opacity)
        added = {name: getattr(self, name)[copied] for name in NAMES}
        for sign in (-1.0, 1.0):
            halves = {name: getattr(self, name)[split] for name in NAMES}
            halves["means"] = halves["means"] + 0.5 * sign * halves["scales"].exp()
            halves["scales"] = halves["scales"] - torch.log(torch.tensor(1.6, device="cuda"))
            added = {name: torch.cat([added[name], halves[name]]) for name in NAMES}
        for group in self.optimizer.param_groups:
            name, old = group["name"], group["params"][0]
            new = nn.Parameter(torch.cat([old[kept], added[name]]))
            state = self.optimizer.state.pop(old, None)
            if state is not None:
                for moment in ("exp_avg", "exp_avg_sq"):
                    state[moment] = torch.cat([state[moment][kept], torch.zeros_like(added[name])])
                self.optimizer.state[new] = state
            group["params"] = [new]
            setattr(self, name, new)
        self.forget_gradients()
        torch.cuda.empty_cache()
