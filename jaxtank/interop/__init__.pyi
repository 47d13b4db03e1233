from jaxtank.interop import gymnasium as gymnasium
from jaxtank.interop import python_control as python_control
