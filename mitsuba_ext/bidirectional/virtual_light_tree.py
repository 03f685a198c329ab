from .virtual_light_choice import UniformChoice as ClusteredChoice
