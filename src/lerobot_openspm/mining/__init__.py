"""From demonstrations to key poses: signals, key poses, anchors. One episode in, key poses out."""
