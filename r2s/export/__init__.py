"""Export a trained policy as a bundle, so that other programs can run the policy without r2s."""
