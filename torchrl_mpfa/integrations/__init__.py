"""Parts for TorchRL's trainers, for Hydra and for Ray, each imported by its own module alone."""
