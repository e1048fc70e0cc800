"""Judgement of phases by a multimodal model: the third kind of evidence for key poses."""
