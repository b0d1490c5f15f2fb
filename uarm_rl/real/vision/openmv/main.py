"""The camera's side of ``uarm_rl.real.vision.camera.OpenMVCamera``: MicroPython for an OpenMV M4, M7, H7 or H7 Plus.

Copy this file onto the drive that the camera shows when it is plugged in, under the name ``main.py``, eject the drive,
close OpenMV IDE (it occupies the USB connection), and plug the camera in anew. It runs with the ``csi`` module of
firmware 4.8 and later and with the ``sensor`` module of earlier firmware.

Protocol: the computer sends ``snap``; the camera takes a picture and answers with its length in bytes (four bytes,
little endian) and the picture as JPEG. Requests are recognised by their last four bytes, so a byte too many or too few
spoils one request and not those after it.

Colours and positions are measured in these pictures, hence:

- Exposure, gain and white balance are found by the camera in the first two seconds and then kept. Otherwise the arm's
  shadow or a bright object would shift all colours. The light must be on when the camera is plugged in; when it changes,
  plug the camera in anew.
- JPEG quality 90. Below 60 the encoder stores the colours at half the resolution, and a coloured blob's edge moves.
- 320 x 240 in colour: 640 x 480 does not fit the memory of an M7 or H7, and the firmware would silently cut the picture.
- No mirroring, no windowing, no lens correction: each would change what the calibration measured.
- The lens is focused by turning it. Do it once, with the object at its usual distance, then fix the lens with its ring
  and calibrate: turning it later changes the focal length.
"""

import struct

from pyb import USB_VCP

SETTLE_MS = 2000
JPEG_QUALITY = 90  # 60 or more


def start_csi(csi):
    """Firmware 4.8 and later; returns the function that takes a picture."""
    camera = csi.CSI()
    camera.reset()
    camera.pixformat(csi.RGB565)
    camera.framesize(csi.QVGA)
    camera.snapshot(time=SETTLE_MS)
    camera.auto_gain(False, gain_db=camera.gain_db())
    camera.auto_whitebal(False, rgb_gain_db=camera.rgb_gain_db())
    camera.auto_exposure(False, exposure_us=camera.exposure_us())
    camera.snapshot(time=200)  # until the fixed values are in force
    return camera.snapshot


def start_sensor(sensor):
    """Earlier firmware; returns the function that takes a picture."""
    sensor.reset()
    sensor.set_pixformat(sensor.RGB565)
    sensor.set_framesize(sensor.QVGA)
    sensor.skip_frames(time=SETTLE_MS)
    sensor.set_auto_gain(False, gain_db=sensor.get_gain_db())
    sensor.set_auto_whitebal(False, rgb_gain_db=sensor.get_rgb_gain_db())
    sensor.set_auto_exposure(False, exposure_us=sensor.get_exposure_us())
    sensor.skip_frames(time=200)
    return sensor.snapshot


def start():
    """The function that takes a picture, with whatever firmware this is."""
    try:
        import csi
    except ImportError:
        import sensor

        return start_sensor(sensor)
    return start_csi(csi)


def jpeg(image):
    """The picture as a JPEG image; early firmware knows the older name alone."""
    if hasattr(image, "to_jpeg"):
        return image.to_jpeg(quality=JPEG_QUALITY)
    return image.compress(quality=JPEG_QUALITY)


def take(snapshot):
    """A picture, however many frames the sensor misses."""
    while True:
        try:
            return jpeg(snapshot())
        except RuntimeError:
            pass


def serve(usb, snapshot):
    """Answer requests for ever."""
    usb.setinterrupt(-1)  # a byte 3 on the line is not Ctrl-C
    last = b""
    while True:
        last = (last + usb.recv(1, timeout=5000))[-4:]
        if last == b"snap":
            last = b""
            picture = take(snapshot)
            usb.send(struct.pack("<L", picture.size()))
            usb.send(picture)


serve(USB_VCP(), start())
