"""One Vulkan device, its queue, and the end of everything that was made on it."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Any

from bake_core.errors import MachineError
from bake_core.vulkan.commands import Commands
from bake_core.vulkan.loader import INSTALL, vk

VALIDATION_LAYER = "VK_LAYER_KHRONOS_validation"
# Names (a part of) the device to use instead of the software one: a person's choice, as pictures may differ in their last bits.
DEVICE_VARIABLE = "OCTOBAKE_VULKAN_DEVICE"


class Device:
    """A logical device with one queue: by default the CPU's (lavapipe), so that pictures do not depend on the machine.

    A context manager; leaving it frees every object made on it. Where the validation layers are installed they watch, and a message
    of theirs is an error. Not to be shared between threads.

    Attributes
    ----------
    name : str
        The driver's name for the device.
    validated : bool
        Whether the validation layers watch.

    Raises
    ------
    MachineError
        ``vulkan.missing`` without a driver or a fitting device, ``vulkan.too_old`` below Vulkan 1.3, ``vulkan.failed`` when the driver
        refuses.
    """

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._messages: list[str] = []
        try:
            self._open()
        except BaseException:
            self._stack.close()
            raise

    def _open(self) -> None:
        self.validated = VALIDATION_LAYER in {layer.layerName for layer in vk.vkEnumerateInstanceLayerProperties()}
        instance = self._instance()
        self.physical, properties = self._choose(instance)
        self.name = str(properties.deviceName)
        self.memory_types = vk.vkGetPhysicalDeviceMemoryProperties(self.physical)
        family = self._queue_family()
        # maintenance4: SPIR-V for Vulkan 1.3 gives the size of work groups by constants.
        modern = vk.VkPhysicalDeviceVulkan13Features(synchronization2=True, dynamicRendering=True, maintenance4=True)
        priorities = vk.VkDeviceQueueCreateInfo(queueFamilyIndex=family, queueCount=1, pQueuePriorities=[1.0])
        info = vk.VkDeviceCreateInfo(pNext=modern, pQueueCreateInfos=[priorities], pEnabledFeatures=vk.VkPhysicalDeviceFeatures())
        self.handle = self._call(vk.vkCreateDevice, self.physical, info, None)
        self._stack.callback(vk.vkDestroyDevice, self.handle, None)
        self.queue = vk.vkGetDeviceQueue(self.handle, family, 0)
        pool_info = vk.VkCommandPoolCreateInfo(flags=vk.VK_COMMAND_POOL_CREATE_TRANSIENT_BIT, queueFamilyIndex=family)
        self._pool = self.make(vk.vkCreateCommandPool, vk.vkDestroyCommandPool, pool_info)
        self._fence = self.make(vk.vkCreateFence, vk.vkDestroyFence, vk.VkFenceCreateInfo())

    def _instance(self) -> Any:
        layers, extensions, chain = [], [], None
        if self.validated:
            layers, extensions = [VALIDATION_LAYER], [vk.VK_EXT_DEBUG_UTILS_EXTENSION_NAME]
            chain = self._messenger_info()
        application = vk.VkApplicationInfo(pApplicationName="octobake", apiVersion=vk.VK_MAKE_VERSION(1, 3, 0))
        info = vk.VkInstanceCreateInfo(
            pNext=chain, pApplicationInfo=application, ppEnabledLayerNames=layers, ppEnabledExtensionNames=extensions
        )
        instance = self._call(vk.vkCreateInstance, info, None)
        self._stack.callback(vk.vkDestroyInstance, instance, None)
        if self.validated:
            messenger = vk.vkGetInstanceProcAddr(instance, "vkCreateDebugUtilsMessengerEXT")(instance, chain, None)
            destroy = vk.vkGetInstanceProcAddr(instance, "vkDestroyDebugUtilsMessengerEXT")
            self._stack.callback(destroy, instance, messenger, None)
        return instance

    def _messenger_info(self) -> Any:
        # One C callback serves the whole process, so it finds its device by the handle. The handle lives as long as the device.
        self._handle = vk.ffi.new_handle(self._messages)
        severity = vk.VK_DEBUG_UTILS_MESSAGE_SEVERITY_WARNING_BIT_EXT | vk.VK_DEBUG_UTILS_MESSAGE_SEVERITY_ERROR_BIT_EXT
        # Not its performance advice: that every image stays in GENERAL is a choice (see commands.py).
        return vk.VkDebugUtilsMessengerCreateInfoEXT(
            messageSeverity=severity,
            messageType=vk.VK_DEBUG_UTILS_MESSAGE_TYPE_VALIDATION_BIT_EXT,
            pfnUserCallback=_remember,
            pUserData=self._handle,
        )

    def _choose(self, instance: Any) -> tuple[Any, Any]:
        wanted = os.environ.get(DEVICE_VARIABLE)
        found = [(p, vk.vkGetPhysicalDeviceProperties(p)) for p in self._call(vk.vkEnumeratePhysicalDevices, instance)]
        for physical, properties in found:
            if wanted is None and properties.deviceType != vk.VK_PHYSICAL_DEVICE_TYPE_CPU:
                continue
            if wanted is not None and wanted.lower() not in properties.deviceName.lower():
                continue
            if properties.apiVersion < vk.VK_MAKE_VERSION(1, 3, 0):
                raise MachineError("vulkan.too_old", "offers less than Vulkan 1.3; Mesa 22.1 or newer does", properties.deviceName)
            return physical, properties
        others = ", ".join(properties.deviceName for _, properties in found) or "none"
        kind = f"no Vulkan device is called {wanted!r}" if wanted is not None else "no Vulkan driver that renders on the CPU"
        advice = f"unset {DEVICE_VARIABLE} or name one of them" if wanted is not None and found else INSTALL
        raise MachineError("vulkan.missing", f"{kind} (found: {others}); {advice}")

    def _queue_family(self) -> int:
        both = vk.VK_QUEUE_GRAPHICS_BIT | vk.VK_QUEUE_COMPUTE_BIT
        for i, family in enumerate(vk.vkGetPhysicalDeviceQueueFamilyProperties(self.physical)):
            if family.queueFlags & both == both:
                return i
        raise MachineError("vulkan.missing", "has no queue that both draws and computes", self.name)

    def make(self, create: Callable[..., Any], destroy: Callable[..., Any], info: Any) -> Any:
        """Create an object that this device destroys in its end."""
        made = self._call(create, self.handle, info, None)
        self._stack.callback(destroy, self.handle, made, None)
        self.check()
        return made

    def later(self, end: Callable[..., Any], *arguments: Any) -> None:
        """Call `end` when the device ends, before anything that was made earlier is destroyed."""
        self._stack.callback(end, *arguments)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            made = function(*arguments)
        except (vk.VkErrorIncompatibleDriver, vk.VkErrorInitializationFailed):
            raise MachineError("vulkan.missing", f"no Vulkan driver can be loaded; {INSTALL}") from None
        except vk.VkError as e:
            raise MachineError("vulkan.failed", f"{function.__name__}: {type(e).__name__}") from None
        return made

    def check(self) -> None:
        """Raise what the validation layers had to say.

        Raises
        ------
        MachineError
            ``vulkan.validation``
        """
        if self._messages:
            first, more = self._messages[0], len(self._messages) - 1
            self._messages.clear()
            raise MachineError("vulkan.validation", first.replace("\n", " ") + (f" (and {more} more)" if more else ""))

    def run(self, record: Callable[[Commands], None]) -> None:
        """Record commands, run them and wait until they are done; only then complain, as nothing in use may be destroyed."""
        allocate = vk.VkCommandBufferAllocateInfo(commandPool=self._pool, level=vk.VK_COMMAND_BUFFER_LEVEL_PRIMARY, commandBufferCount=1)
        buffer = vk.vkAllocateCommandBuffers(self.handle, allocate)[0]
        try:
            once = vk.VkCommandBufferBeginInfo(flags=vk.VK_COMMAND_BUFFER_USAGE_ONE_TIME_SUBMIT_BIT)
            vk.vkBeginCommandBuffer(buffer, once)
            record(Commands(buffer))
            vk.vkEndCommandBuffer(buffer)
            commands = vk.VkCommandBufferSubmitInfo(commandBuffer=buffer)
            submits = [vk.VkSubmitInfo2(pCommandBufferInfos=[commands])]
            self._call(vk.vkQueueSubmit2, self.queue, 1, submits, self._fence)
            self._call(vk.vkWaitForFences, self.handle, 1, [self._fence], True, 2**64 - 1)
            self._call(vk.vkResetFences, self.handle, 1, [self._fence])
        finally:
            vk.vkFreeCommandBuffers(self.handle, self._pool, 1, [buffer])
        self.check()

    def close(self) -> None:
        """Destroy everything; the validation layers' last words are an error, too."""
        self._stack.close()
        self.check()

    def __enter__(self) -> Device:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None:
            self.close()
        else:
            # The first error is the one to report, not what it leaves behind.
            self._stack.close()


def _remember(severity: int, kind: int, data: Any, messages: Any) -> int:
    vk.ffi.from_handle(messages).append(vk.ffi.string(data.pMessage).decode(errors="replace"))
    return 0
