"""The interfaces of other rasterizers, over this package's stages."""
