"""Depth of field as an image filter: of colour and depth (:func:`filters.defocus`), or of layers
that also contain hidden surfaces (:class:`filters.Capture`)."""
