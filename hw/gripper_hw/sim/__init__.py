"""One MuJoCo world behind a virtual servo, a camera and a load cell."""
