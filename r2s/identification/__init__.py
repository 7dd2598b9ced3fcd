"""Real2Sim: estimate friction, inertia, offsets and timing of an arm from a recording.

identify.py is the entry point and lists the steps of an identification. residuals/ compares a model with a recording;
search/ minimizes the residuals. structure/ selects the friction family and the model terms by cross-validation.
friction/ estimates breakaway, presliding and stiction. payload/ and contact/ identify a payload and a surface.
"""
