"""A filter between a policy and the wheels, which keeps the robot off what its lidar sees."""
