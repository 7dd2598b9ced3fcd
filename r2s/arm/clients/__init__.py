"""Clients that command a Panda or an FR3 through libfranka, on hardware or on the emulator."""
