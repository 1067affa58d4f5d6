"""A trained policy as a ROS 2 node, and a simulated robot to try it on.

What they decide is in plain classes, :class:`~mpfa_envs.ros.controller.Controller` and
:class:`~mpfa_envs.ros.simulated_robot.SimulatedRobot`; ``policy_node.py`` and ``robot_node.py``
pass messages to them and need ``rclpy``, which a ROS 2 installation has::

    python -m mpfa_envs.ros.policy_node --ros-args -p policy:=policy.onnx -p robot:=turtlebot4
    python -m mpfa_envs.ros.robot_node --ros-args -p world:=test
"""
