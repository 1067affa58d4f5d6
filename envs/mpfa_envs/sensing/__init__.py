"""What a robot senses: lidar, the map that it makes, and the observation."""
