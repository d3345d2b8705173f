"""Memory on the device: storage buffers, sampled textures, and the targets that pictures are drawn into."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bake_core.errors import MachineError
from bake_core.vulkan.loader import vk

if TYPE_CHECKING:
    from bake_core.vulkan.device import Device

F32 = NDArray[np.float32]
_FORMATS = {
    (np.float32, 1): "VK_FORMAT_R32_SFLOAT",
    (np.float32, 2): "VK_FORMAT_R32G32_SFLOAT",
    (np.float32, 4): "VK_FORMAT_R32G32B32A32_SFLOAT",
    (np.uint16, 4): "VK_FORMAT_R16G16B16A16_UNORM",
}


@dataclass(frozen=True)
class Buffer:
    """A storage buffer that host and device both see. `mapped` is a view of its bytes; it dies with the device."""

    handle: Any
    size: int
    mapped: NDArray[np.uint8]

    def read(self, dtype: type[np.generic], shape: tuple[int, ...]) -> NDArray[Any]:
        """Copy the buffer's beginning into a new array."""
        count = int(np.prod(shape)) * np.dtype(dtype).itemsize
        return self.mapped[:count].copy().view(dtype).reshape(shape)

    def write(self, data: NDArray[Any]) -> None:
        """Copy an array to the buffer's beginning."""
        raw = np.ascontiguousarray(data).reshape(-1).view(np.uint8)
        self.mapped[: raw.size] = raw


@dataclass(frozen=True)
class Image:
    """A 2D array image in the layout GENERAL.

    Attributes
    ----------
    handle, view : Vulkan's image and its view as a 2D array.
    layer_views : list
        Single layers, to draw into; empty for textures.
    sampler : Vulkan's sampler, or None where the image is only drawn into.
    width, height, layers, channels : int
    aspect : int
        VK_IMAGE_ASPECT_COLOR_BIT or VK_IMAGE_ASPECT_DEPTH_BIT.
    format : int
    """

    handle: Any
    view: Any
    layer_views: list[Any]
    sampler: Any
    width: int
    height: int
    layers: int
    channels: int
    aspect: int
    format: int

    @property
    def bytes(self) -> int:
        """Size of all texels, packed; for those that are drawn into."""
        return self.width * self.height * self.layers * self.channels * 4


def storage(device: Device, data: NDArray[Any] | int) -> Buffer:
    """A storage buffer holding `data`, or of so many bytes; at least 16, so that nothing need be said about empty arrays."""
    raw = None if isinstance(data, int) else np.ascontiguousarray(data).reshape(-1).view(np.uint8)
    size = max(16, data if isinstance(data, int) else data.nbytes)
    most = vk.vkGetPhysicalDeviceProperties(device.physical).limits.maxStorageBufferRange
    if size > most:
        raise MachineError("vulkan.buffer_too_large", f"{size} bytes in one buffer are more than {device.name} takes ({most})")
    return _buffer(device, size, raw)


def _buffer(device: Device, size: int, raw: NDArray[np.uint8] | None) -> Buffer:
    usage = vk.VK_BUFFER_USAGE_STORAGE_BUFFER_BIT | vk.VK_BUFFER_USAGE_TRANSFER_SRC_BIT | vk.VK_BUFFER_USAGE_TRANSFER_DST_BIT
    info = vk.VkBufferCreateInfo(size=size, usage=usage, sharingMode=vk.VK_SHARING_MODE_EXCLUSIVE)
    handle = device.make(vk.vkCreateBuffer, vk.vkDestroyBuffer, info)
    seen = vk.VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | vk.VK_MEMORY_PROPERTY_HOST_COHERENT_BIT
    memory = _allocate(device, vk.vkGetBufferMemoryRequirements(device.handle, handle), seen)
    vk.vkBindBufferMemory(device.handle, handle, memory, 0)
    mapped = np.frombuffer(vk.vkMapMemory(device.handle, memory, 0, size, 0), np.uint8)
    buffer = Buffer(handle, size, mapped)
    if raw is not None:
        mapped[: raw.size] = raw
    return buffer


def texture(device: Device, texels: F32 | NDArray[np.uint16], *, linear: bool) -> Image:
    """A sampled texture, clamped at its edges, without mip levels.

    Parameters
    ----------
    texels : (layers, height, width, channels) float32 or uint16
        1, 2 or 4 channels; uint16 has 4, and shaders see it in [0, 1].
    linear : bool
        Between texels; else the nearest.
    """
    layers, height, width, channels = texels.shape
    usage = vk.VK_IMAGE_USAGE_SAMPLED_BIT | vk.VK_IMAGE_USAGE_TRANSFER_DST_BIT
    kind = getattr(vk, _FORMATS[texels.dtype.type, channels])
    image = _image(device, width, height, layers, channels, kind, usage, vk.VK_IMAGE_ASPECT_COLOR_BIT, linear=linear)
    # No shader reads it there, so it may be larger than a storage buffer.
    source = _buffer(device, texels.nbytes, np.ascontiguousarray(texels).reshape(-1).view(np.uint8))
    device.run(lambda commands: commands.upload(source, image))
    return image


def color_target(device: Device, width: int, height: int) -> Image:
    """A picture of four float32 channels, to draw into and to read back."""
    usage = vk.VK_IMAGE_USAGE_COLOR_ATTACHMENT_BIT | vk.VK_IMAGE_USAGE_TRANSFER_SRC_BIT
    return _image(device, width, height, 1, 4, vk.VK_FORMAT_R32G32B32A32_SFLOAT, usage, vk.VK_IMAGE_ASPECT_COLOR_BIT)


def depth_target(device: Device, width: int, height: int, layers: int = 1, *, sampled: bool = False) -> Image:
    """Float32 depths to draw against and to read back; `sampled`: also to be looked up (a shadow map)."""
    usage = vk.VK_IMAGE_USAGE_DEPTH_STENCIL_ATTACHMENT_BIT | vk.VK_IMAGE_USAGE_TRANSFER_SRC_BIT
    if sampled:
        usage |= vk.VK_IMAGE_USAGE_SAMPLED_BIT
    aspect = vk.VK_IMAGE_ASPECT_DEPTH_BIT
    return _image(device, width, height, layers, 1, vk.VK_FORMAT_D32_SFLOAT, usage, aspect, linear=False if sampled else None)


def _image(
    device: Device, width: int, height: int, layers: int, channels: int, kind: int, usage: int, aspect: int, *, linear: bool | None = None
) -> Image:
    limits = vk.vkGetPhysicalDeviceProperties(device.physical).limits
    if max(width, height) > limits.maxImageDimension2D or layers > limits.maxImageArrayLayers:
        most = f"{limits.maxImageDimension2D}² × {limits.maxImageArrayLayers}"
        raise MachineError("vulkan.image_too_large", f"{width}×{height}×{layers} texels are more than {device.name} takes ({most})")
    info = vk.VkImageCreateInfo(
        imageType=vk.VK_IMAGE_TYPE_2D,
        format=kind,
        extent=vk.VkExtent3D(width, height, 1),
        mipLevels=1,
        arrayLayers=layers,
        samples=vk.VK_SAMPLE_COUNT_1_BIT,
        tiling=vk.VK_IMAGE_TILING_OPTIMAL,
        usage=usage,
        sharingMode=vk.VK_SHARING_MODE_EXCLUSIVE,
        initialLayout=vk.VK_IMAGE_LAYOUT_UNDEFINED,
    )
    handle = device.make(vk.vkCreateImage, vk.vkDestroyImage, info)
    memory = _allocate(device, vk.vkGetImageMemoryRequirements(device.handle, handle), vk.VK_MEMORY_PROPERTY_DEVICE_LOCAL_BIT)
    vk.vkBindImageMemory(device.handle, handle, memory, 0)
    drawn = usage & (vk.VK_IMAGE_USAGE_COLOR_ATTACHMENT_BIT | vk.VK_IMAGE_USAGE_DEPTH_STENCIL_ATTACHMENT_BIT)
    views = [_view(device, handle, kind, aspect, vk.VK_IMAGE_VIEW_TYPE_2D, i, 1) for i in range(layers)] if drawn else []
    view = _view(device, handle, kind, aspect, vk.VK_IMAGE_VIEW_TYPE_2D_ARRAY, 0, layers) if linear is not None else None
    sampler = _sampler(device, linear=linear) if linear is not None else None
    image = Image(handle, view, views, sampler, width, height, layers, channels, aspect, kind)
    device.run(lambda commands: commands.prepare(image))
    return image


def _view(device: Device, image: Any, kind: int, aspect: int, view_type: int, layer: int, layers: int) -> Any:
    part = vk.VkImageSubresourceRange(aspect, 0, 1, layer, layers)
    info = vk.VkImageViewCreateInfo(image=image, viewType=view_type, format=kind, subresourceRange=part)
    return device.make(vk.vkCreateImageView, vk.vkDestroyImageView, info)


def _sampler(device: Device, *, linear: bool) -> Any:
    method = vk.VK_FILTER_LINEAR if linear else vk.VK_FILTER_NEAREST
    edge = vk.VK_SAMPLER_ADDRESS_MODE_CLAMP_TO_EDGE
    info = vk.VkSamplerCreateInfo(magFilter=method, minFilter=method, addressModeU=edge, addressModeV=edge, addressModeW=edge)
    return device.make(vk.vkCreateSampler, vk.vkDestroySampler, info)


def _allocate(device: Device, needs: Any, properties: int) -> Any:
    types = [device.memory_types.memoryTypes[i] for i in range(device.memory_types.memoryTypeCount)]
    for i, memory_type in enumerate(types):
        if needs.memoryTypeBits & 1 << i and memory_type.propertyFlags & properties == properties:
            info = vk.VkMemoryAllocateInfo(allocationSize=needs.size, memoryTypeIndex=i)
            return device.make(vk.vkAllocateMemory, vk.vkFreeMemory, info)
    raise MachineError("vulkan.failed", "offers no memory of the kind that is needed", device.name)
