"""Draw figures (PNG) of learning curves and episodes; provide panels, colors and thinned logs for other figures."""
