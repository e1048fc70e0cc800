"""Acting: key poses carried over to the scene, and the state of one environment."""
