"""`python -m r2s.arm.emulator`: serve a twin until Ctrl-C."""

from r2s.arm.emulator.process import main

main()
