"""A PyBullet navigation task for gymnasium and TorchRL."""
