"""Prepares LLVM, Mitsuba and the plugins before a scene is read; describes the machine."""
