"""Export a trained policy as a bundle, with which another program can run the policy without r2s."""
