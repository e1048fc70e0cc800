"""Backends that turn phrases and views into masks, boxes and confidences (:class:`..types.Segmenter`)."""
