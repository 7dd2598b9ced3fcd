"""The arm itself, or what stands in for it: one protocol, a hidden twin, hardware adapters."""
