"""Captures: photographs with their cameras, points, masks and depths, read from folders, and measured."""
