// SPDX-License-Identifier: Apache-2.0
using System.IO;
using UnrealBuildTool;

public class CaviarWorld : ModuleRules
{
    public CaviarWorld(ReadOnlyTargetRules Target) : base(Target)
    {
        PCHUsage = PCHUsageMode.UseExplicitOrSharedPCHs;
        PublicDependencyModuleNames.AddRange(new[] { "Core", "CoreUObject", "Engine", "PhysicsCore" });

        // caviar.hpp, libzmq's zmq.h and its static library, put there as README.md says. Exceptions and RTTI stay
        // off, which is Unreal's default.
        string ThirdParty = Path.Combine(ModuleDirectory, "ThirdParty");
        PrivateIncludePaths.Add(Path.Combine(ThirdParty, "include"));
        PrivateDefinitions.Add("ZMQ_STATIC=1");
        if (Target.Platform == UnrealTargetPlatform.Win64)
        {
            PublicAdditionalLibraries.Add(Path.Combine(ThirdParty, "lib", "libzmq.lib"));
            PublicSystemLibraries.AddRange(new[] { "ws2_32.lib", "iphlpapi.lib", "advapi32.lib" });
        }
        else
        {
            PublicAdditionalLibraries.Add(Path.Combine(ThirdParty, "lib", "libzmq.a"));
        }
    }
}
