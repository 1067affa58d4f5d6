"""The navigation task as environments: many robots, one robot, TorchRL."""
