"""What happens before a scene is read: LLVM, Mitsuba, plugins. Facts about this machine."""
