"""Real2Sim: estimate friction, inertia, offsets and timing of an arm from a recording.

identify.py is the entry point and lists the steps of an identification. residuals/ computes deviations of a model
from a recording; search/ minimizes them. structure/ selects the friction family and the model terms by
cross-validation. friction/ estimates breakaway torques, presliding and stiction. payload/ identifies a payload,
contact/ a surface, gears/ the stiffness of elastic gears.
"""
