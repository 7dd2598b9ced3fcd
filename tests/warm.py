"""Import this in a process that commands are forked off: what each of them would compile again is then there."""

from r2s.physics import native_friction

native_friction.install()
