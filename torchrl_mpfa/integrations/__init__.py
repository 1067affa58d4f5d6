"""Parts for frameworks: TorchRL's trainers and Hydra."""
