from jaxtank.interop import gymnasium as gymnasium, python_control as python_control
