"""Depth of field as a filter of pictures: of colour and depth (:func:`filters.defocus`), or of
layers that also contain hidden surfaces (:class:`filters.Capture`)."""
