"""What a scene calls for, as bounds on what leaving an effect out would change."""

from __future__ import annotations

from .harmonics import needed_sh_degree, sh_band_bounds  # noqa: F401
