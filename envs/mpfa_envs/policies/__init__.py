"""Trained policies and their files, npz and ONNX."""
