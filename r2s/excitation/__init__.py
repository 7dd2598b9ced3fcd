"""Motions worth recording, and whether a motion is safe to send."""
