"""Image files, their metrics, and the denoiser."""
