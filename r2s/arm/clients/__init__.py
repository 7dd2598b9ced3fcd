"""Clients of Franka arms through libfranka: Panda and FR3, hardware or the emulator."""
